"""Coordinates that no sensor sees: canonical form, start in closed form, physical structure and what it determines."""

from .assemblies import canonical_structure as canonical_structure
from .canonical import Canonical as Canonical
from .canonical import canonical_count as canonical_count
from .canonical import canonical_gauge as canonical_gauge
from .closed_form import canonical_of as canonical_of
from .closed_form import closed_form as closed_form
from .connections import Connected as Connected
from .connections import Connections as Connections
from .connections import fixed_elements as fixed_elements
from .connections import is_connections as is_connections
from .determinacy import Determinacy as Determinacy
from .determinacy import determinacy as determinacy
from .drift import MEMORIES as MEMORIES
from .drift import high_passed as high_passed
from .drift import in_units as in_units
from .evidence import Element as Element
from .evidence import HiddenEvidence as HiddenEvidence
from .evidence import OrderEvidence as OrderEvidence
from .evidence import OrderStep as OrderStep
from .matching import matched as matched
from .projection import physical_canonical as physical_canonical
from .realizations import HigherOrder as HigherOrder
from .realizations import block_row_choices as block_row_choices
from .realizations import realizations as realizations
from .transfer import Family as Family
from .transfer import realized_response as realized_response
