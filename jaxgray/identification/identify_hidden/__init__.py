"""Models with coordinates that no output measures: how many, which form, and how they are found."""

from .identify import identify_hidden as identify_hidden
from .identify import other_models as other_models
from .order import identify_auto as identify_auto
from .request import HiddenRequest as HiddenRequest
from .request import wants_hidden as wants_hidden
