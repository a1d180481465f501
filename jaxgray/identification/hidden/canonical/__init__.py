"""The representative that inputs and outputs determine: its form, its start in closed form, what is free in it.

form         the canonical form
closed_form  from a realisation to it, in closed form
traced       the same as traced code
projection   the nearest physical model of it
assemblies   what is free in M, D and K
"""

from .assemblies import canonical_structure as canonical_structure
from .closed_form import canonical_of as canonical_of
from .closed_form import closed_form as closed_form
from .form import Canonical as Canonical
from .form import canonical_count as canonical_count
from .form import canonical_gauge as canonical_gauge
from .projection import physical_canonical as physical_canonical
from .traced import traced_canonical as traced_canonical
