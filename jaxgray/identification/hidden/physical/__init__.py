"""Masses, springs and dampers between named coordinates: found from a transfer function, and whether they can be.

connections  springs and dampers between named coordinates
transfer     transfer functions and their derivatives
matching     parameters from a transfer function, and every other set that gives the same
determinacy  whether inputs and outputs determine them
"""

from .connections import Connected as Connected
from .connections import Connections as Connections
from .connections import fixed_elements as fixed_elements
from .connections import is_connections as is_connections
from .determinacy import Determinacy as Determinacy
from .determinacy import determinacy as determinacy
from .matching import alike as alike
from .matching import matched as matched
from .transfer import Family as Family
from .transfer import realized_response as realized_response
