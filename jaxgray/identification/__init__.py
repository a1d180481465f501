"""How the model is found: λ-domain subspace or regression start, then prediction-error refinement.

batch           many records side by side, each a system of its own
estimate         from a record to M, D, K as one pure function, to be differentiated
stabilisation    poles over the model order
streaming        records longer than memory
sweep            the subspace start over τ and block rows
standing         uniform records that stand for these
identify         from records to a model: the pipeline
stamped          records with rows at times of their own
clocks           clocks of outputs beside that of the inputs
identify_hidden  models with hidden coordinates: the pipeline
result           the identification as one immutable result
hidden           coordinates that no sensor sees: canonical form, structure
initialization   starting models, compared by free runs
validation       whether a model and its record go together
refinement       prediction-error refinement, and uncertainties
subspace         from filtered records to a realisation, in closed form
setup            what an identification works on

Imports go down this list.
"""

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
