"""How the model is found: λ-domain subspace or regression start, then prediction-error refinement."""

from .identify import identify as identify
from .result import Identification as Identification
