"""How the model is found: λ-domain subspace or regression start, then prediction-error refinement."""

from .estimate import Estimate as Estimate
from .estimate import RowWeights as RowWeights
from .estimate import estimate as estimate
from .identify import identify as identify
from .many import identify_many as identify_many
from .many_result import Identifications as Identifications
from .result import Identification as Identification
from .stabilisation import Stabilisation as Stabilisation
from .stabilisation import stabilisation as stabilisation
from .streaming import CompressedRecord as CompressedRecord
from .streaming import compress as compress
from .sweeping import Sweep as Sweep
from .sweeping import sweep as sweep
