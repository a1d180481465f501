"""Physical mass, damping and stiffness from measured force and motion, and what a simulation with them gets wrong."""

import importlib
from typing import TYPE_CHECKING

from .numerics.notebook import show_with
from .numerics.programs.backend import prepare as _prepare

if TYPE_CHECKING:
    from .diagnosis.diagnose import diagnose as diagnose
    from .diagnosis.result import Diagnosis as Diagnosis
    from .fleets import fleet as fleet
    from .identification import CompressedRecord as CompressedRecord
    from .identification import Estimate as Estimate
    from .identification import Identification as Identification
    from .identification import Identifications as Identifications
    from .identification import RowWeights as RowWeights
    from .identification import Stabilisation as Stabilisation
    from .identification import Sweep as Sweep
    from .identification import compress as compress
    from .identification import estimate as estimate
    from .identification import identify as identify
    from .identification import identify_many as identify_many
    from .identification import stabilisation as stabilisation
    from .identification import sweep as sweep
    from .mechanics.effects import CATALOGUE as CATALOGUE
    from .mechanics.energy import energy_balance as energy_balance
    from .mechanics.model import MechanicalModel as MechanicalModel
    from .mechanics.systems.drives import BaseAcceleration as BaseAcceleration
    from .mechanics.systems.drives import BaseDisplacement as BaseDisplacement
    from .mechanics.systems.drives import Force as Force
    from .mechanics.systems.statespace import StateSpace as StateSpace
    from .numerics.outcomes import RESULTS as RESULTS
    from .numerics.outcomes import ComputationError as ComputationError
    from .records import Record as Record
    from .records import RecordWarning as RecordWarning
    from .records import preflight as preflight
    from .records import read_record as read_record
    from .report.documents.export import load as load
    from .report.documents.export import save as save
    from .report.documents.simulated import write_simulation as write_simulation
    from .report.exports import export as export
    from .report.exports import to_control as to_control
    from .report.exports import to_scipy as to_scipy
    from .report.page.whole import write_report as write_report
    from .schemas import schema as schema
    from .simulators import FmuSimulator as FmuSimulator
    from .simulators import MujocoSimulator as MujocoSimulator

_prepare()

_HOMES = {
    "diagnosis.diagnose": ("diagnose",),
    "diagnosis.result": ("Diagnosis",),
    "fleets": ("fleet",),
    "identification": (
        "CompressedRecord",
        "Estimate",
        "Identification",
        "Identifications",
        "RowWeights",
        "Stabilisation",
        "Sweep",
        "compress",
        "estimate",
        "identify",
        "identify_many",
        "stabilisation",
        "sweep",
    ),
    "mechanics.systems.drives": ("BaseAcceleration", "BaseDisplacement", "Force"),
    "mechanics.effects": ("CATALOGUE",),
    "mechanics.energy": ("energy_balance",),
    "mechanics.model": ("MechanicalModel",),
    "mechanics.systems.statespace": ("StateSpace",),
    "numerics.outcomes": ("RESULTS", "ComputationError"),
    "records": ("Record", "RecordWarning", "preflight", "read_record"),
    "report.documents.export": ("load", "save"),
    "report.page.whole": ("write_report",),
    "report.exports": ("export", "to_control", "to_scipy"),
    "report.documents.simulated": ("write_simulation",),
    "schemas": ("schema",),
    "simulators": ("FmuSimulator", "MujocoSimulator"),
}
__all__ = tuple(name for names in _HOMES.values() for name in names)  # noqa: PLE0604


def _html(result) -> str | None:
    # What shows results is fetched when a notebook first asks.
    from .report.notebook import html

    return html(result)


show_with(_html)


def __getattr__(name: str):
    # Public names are fetched when first used, so that the command can answer before jax is loaded.
    for home, names in _HOMES.items():
        if name in names:
            value = getattr(importlib.import_module(f"{__name__}.{home}"), name)
            globals()[name] = value
            return value
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    # What a user needs: neither submodules nor what this file is made with.
    return sorted((*__all__, "__version__"))
