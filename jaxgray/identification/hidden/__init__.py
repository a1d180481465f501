"""Coordinates that no sensor sees: canonical form, start in closed form, physical structure and what it determines.

canonical     the representative that inputs and outputs determine
physical      masses, springs and dampers between named coordinates
realizations  state-space models of more states than twice the outputs
evidence      what is known of the hidden coordinates beside the model
drift         realisations of records that drift
"""

from .canonical import Canonical as Canonical
from .canonical import canonical_count as canonical_count
from .canonical import canonical_gauge as canonical_gauge
from .canonical import canonical_of as canonical_of
from .canonical import canonical_structure as canonical_structure
from .canonical import closed_form as closed_form
from .canonical import physical_canonical as physical_canonical
from .canonical import traced_canonical as traced_canonical
from .drift import MEMORIES as MEMORIES
from .drift import high_passed as high_passed
from .drift import in_units as in_units
from .evidence import Element as Element
from .evidence import HiddenEvidence as HiddenEvidence
from .evidence import OrderEvidence as OrderEvidence
from .evidence import OrderStep as OrderStep
from .physical import Connected as Connected
from .physical import Connections as Connections
from .physical import Determinacy as Determinacy
from .physical import Family as Family
from .physical import alike as alike
from .physical import determinacy as determinacy
from .physical import fixed_elements as fixed_elements
from .physical import is_connections as is_connections
from .physical import matched as matched
from .physical import realized_response as realized_response
from .realizations import HigherOrder as HigherOrder
from .realizations import block_row_choices as block_row_choices
from .realizations import fitted_input as fitted_input
from .realizations import input_basis as input_basis
from .realizations import realizations as realizations
from .realizations import realized_order as realized_order
