"""What every computation with a mechanical model asks of it."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .drives import AbstractDrive
from .statespace import StateSpace


def effect_names(model) -> str:
    """The effects of a model for a message: `coulomb_friction at y1, end_stop at y2`."""
    return ", ".join(f"{term.effect.id} at {term.place.name}" for term in model.effects)


class AbstractMechanicalModel(eqx.Module):
    """M q̈ + D q̇ + K q = E u with its outputs and effects; `MechanicalModel` says what the fields are."""

    mass: eqx.AbstractVar[Float[Array, "dofs dofs"]]
    damping: eqx.AbstractVar[Float[Array, "dofs dofs"]]
    stiffness: eqx.AbstractVar[Float[Array, "dofs dofs"]]
    drive: eqx.AbstractVar[AbstractDrive]
    measured: eqx.AbstractVar[tuple[str, ...]]
    input_names: eqx.AbstractVar[tuple[str, ...]]
    output_names: eqx.AbstractVar[tuple[str, ...]]
    input_units: eqx.AbstractVar[tuple[str, ...]]
    output_units: eqx.AbstractVar[tuple[str, ...]]
    effects: eqx.AbstractVar[tuple]
    hidden: eqx.AbstractVar[tuple[str, ...]]

    @property
    def dofs(self) -> int:
        """Number of coordinates, measured and hidden."""
        return self.mass.shape[0]

    @property
    def outputs(self) -> int:
        """Number of outputs; output k measures coordinate k."""
        return len(self.output_names)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of all coordinates: those of the outputs, then those that no output measures."""
        return self.output_names + self.hidden

    @property
    def output_map(self) -> Float[np.ndarray, "outputs dofs"]:
        """C of y = C q (or of its derivatives, as `measured` says): ones where an output measures a coordinate."""
        return np.eye(self.outputs, self.dofs)

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.drive.inputs

    def state_space(self, time_unit: float = 1.0) -> StateSpace:
        """First-order form ẋ = A x + B u, y = C x + D u with x = (q, T q̇).

        **Arguments:** `time_unit` (T) [s, default 1]: time is counted in it, so that a fast and a slow system
        look alike to the numerics.

        **Returns:** a `StateSpace` in continuous time.
        """
        return self.drive.state_space(self.mass, self.damping, self.stiffness, self.measured, time_unit)
