"""Physical mass, damping and stiffness matrices from measured force and motion."""

from .identification import Identification as Identification
from .identification import identify as identify
from .mechanics.drives import BaseAcceleration as BaseAcceleration
from .mechanics.drives import BaseDisplacement as BaseDisplacement
from .mechanics.drives import Force as Force
from .mechanics.model import MechanicalModel as MechanicalModel
from .mechanics.statespace import StateSpace as StateSpace
from .numerics.outcomes import RESULTS as RESULTS
from .numerics.outcomes import ComputationError as ComputationError
from .records import Record as Record
from .records import RecordWarning as RecordWarning
from .records import preflight as preflight
from .records import read_record as read_record
