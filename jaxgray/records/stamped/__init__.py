"""Samples at times of their own: what was sampled when, and the uniform grid that stands beside it.

rows    rows of a file, and whether their times matter
stamps  rows as they were sampled
grid    the uniform grid
clocks  clocks that differ from that of the inputs
"""

from .clocks import ClockError as ClockError
from .clocks import mended as mended
from .grid import Grid as Grid
from .grid import grid_of as grid_of
from .grid import inputs_on as inputs_on
from .rows import error_if_uniform as error_if_uniform
from .rows import held as held
from .rows import joined as joined
from .stamps import Stamps as Stamps
