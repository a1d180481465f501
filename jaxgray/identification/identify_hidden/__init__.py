"""Models with coordinates that no output measures: how many, which form, and how they are found.

identify           the pipeline
request            what is asked for
order              how many coordinates are hidden
task               what stays fixed, and the stages that all forms share
start              subspace realisations of the order that is asked for
canonical          the canonical form
structured         masses, dampers and springs that are connected as a person says
structured_starts  where the refinement of these begins
elements           masses, dampers and springs from M, D, K
"""

from .identify import identify_hidden as identify_hidden
from .identify import other_models as other_models
from .order import identify_auto as identify_auto
from .request import HiddenRequest as HiddenRequest
from .request import wants_hidden as wants_hidden
