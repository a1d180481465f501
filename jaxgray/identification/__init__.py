"""How the model is found: λ-domain subspace or regression start, then prediction-error refinement."""

from .batch.many import identify_many as identify_many
from .batch.result import Identifications as Identifications
from .estimate import Estimate as Estimate
from .estimate import RowWeights as RowWeights
from .estimate import estimate as estimate
from .identify import identify as identify
from .result import Identification as Identification
from .stabilisation import Stabilisation as Stabilisation
from .stabilisation import stabilisation as stabilisation
from .streaming import CompressedRecord as CompressedRecord
from .streaming import compress as compress
from .sweep import Sweep as Sweep
from .sweep import sweep as sweep
