"""How the input enters the equation of motion: forces on coordinates, or motion of the base."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...numerics.matrices.namespace import namespace
from .statespace import StateSpace

ORDER = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Time derivatives between a measured quantity and the displacement."""


def as_matrix(given):
    """Nested lists as an array; arrays, traced ones among them, as they are.

    **Raises:** `ValueError` where it has no rows of equal length.
    """
    try:
        matrix = np.asarray(given, float) if isinstance(given, (list, tuple)) else given
    except (TypeError, ValueError):
        matrix = None
    if matrix is None or getattr(matrix, "ndim", 2) != 2:
        raise ValueError(f"input_map is {given!r}; give a row per coordinate with an entry per input, as [[1.0, 0.0]].")
    return matrix


class AbstractDrive(eqx.Module):
    """The way from the input to the coordinates."""

    @abc.abstractmethod
    def state_space(
        self,
        mass: Float[Array, "dofs dofs"],
        damping: Float[Array, "dofs dofs"],
        stiffness: Float[Array, "dofs dofs"],
        measured: tuple[str, ...],
        time_unit: float,
    ) -> StateSpace:
        """First-order form with the state (q, T q̇), time counted in T = `time_unit` [s]."""

    @abc.abstractmethod
    def scaled(
        self, coordinates: Float[Array, " dofs"], inputs: Float[Array, " inputs"], sampling_time: float
    ) -> "AbstractDrive":
        """The same drive where coordinate k, input j and time are counted in these units, the equation of
        motion multiplied by the coordinates' units so that its matrices stay symmetric."""

    @property
    @abc.abstractmethod
    def inputs(self) -> int:
        """Number of inputs."""

    @abc.abstractmethod
    def check(self, dofs: int, measured: tuple[str, ...]) -> None:
        """Raise `ValueError` where these coordinates or measured quantities cannot go with this drive."""


def _core(mass, damping, stiffness, time_unit):
    xp = namespace(mass, damping, stiffness)
    dofs = mass.shape[0]
    A21 = -xp.linalg.solve(mass, stiffness) * time_unit**2
    A22 = -xp.linalg.solve(mass, damping) * time_unit
    A = xp.block([[xp.zeros((dofs, dofs)), xp.eye(dofs)], [A21, A22]])
    return A, A21, A22


def _outputs(position, speed, acceleration, measured, time_unit):
    """Rows of (C, D) picked by measured quantity; each argument is (C, D) in scaled time."""
    xp = namespace(*position, *speed, *acceleration)
    rows = [(position, speed, acceleration)[ORDER[kind]] for kind in measured]
    scale = [time_unit ** -ORDER[kind] for kind in measured]
    C = xp.stack([C[k] * s for k, ((C, _), s) in enumerate(zip(rows, scale))])
    D = xp.stack([D[k] * s for k, ((_, D), s) in enumerate(zip(rows, scale))])
    return C, D


class Force(AbstractDrive):
    """Forces E u on the coordinates: M q̈ + D q̇ + K q = E u.

    **Arguments:** `input_map` (E, dofs × inputs), entry ±1 where an input acts.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> drive = jaxgray.Force(np.array([[1.0, 0.0], [0.0, -1.0]]))  # u1 on q1, u2 against q2
        >>> drive.inputs
        2
    """

    input_map: Float[Array, "dofs inputs"] = eqx.field(converter=as_matrix)

    @property
    def inputs(self):
        return self.input_map.shape[1]

    def scaled(self, coordinates, inputs, sampling_time):
        return Force(coordinates[:, None] * self.input_map * inputs[None, :])

    def check(self, dofs, measured):
        if self.input_map.shape[0] != dofs:
            raise ValueError(
                f"input_map has {self.input_map.shape[0]} rows, but the model has {dofs} coordinates; give one "
                "row per coordinate."
            )

    def state_space(self, mass, damping, stiffness, measured, time_unit):
        xp = namespace(mass, damping, stiffness, self.input_map)
        A, A21, A22 = _core(mass, damping, stiffness, time_unit)
        dofs = mass.shape[0]
        B2 = xp.linalg.solve(mass, self.input_map) * time_unit**2
        none = xp.zeros_like(B2)
        eye = xp.eye(dofs)
        zero = xp.zeros((dofs, dofs))
        C, D = _outputs(
            (xp.hstack([eye, zero]), none),
            (xp.hstack([zero, eye]), none),
            (xp.hstack([A21, A22]), B2),
            measured,
            time_unit,
        )
        return StateSpace(A, xp.vstack([none, B2]), C, D)


class BaseAcceleration(AbstractDrive):
    """Measured base acceleration a: M z̈ + D ż + K z = −M r a, with z = q − r x the motion relative to the base.

    **Arguments:** `direction` (r, dofs × inputs): displacement of each coordinate for a unit rigid motion of
    the base; `relative`: whether the outputs are measured relative to the base. Absolute outputs must be
    accelerations, since the absolute displacement needs the base displacement.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> drive = jaxgray.BaseAcceleration(np.ones((2, 1)), relative=True)
        >>> model = jaxgray.MechanicalModel(np.eye(2), np.eye(2), 100 * np.eye(2), drive=drive)
        >>> model.inputs, model.outputs
        (1, 2)
    """

    direction: Float[Array, "dofs inputs"]
    relative: bool = eqx.field(static=True, default=False)

    @property
    def inputs(self):
        return self.direction.shape[1]

    def scaled(self, coordinates, inputs, sampling_time):
        return BaseAcceleration(
            self.direction * inputs[None, :] / coordinates[:, None] * sampling_time**2, self.relative
        )

    def check(self, dofs, measured):
        if not self.relative and any(kind != "acceleration" for kind in measured):
            raise ValueError(
                f"measured={measured} with a measured base acceleration: absolute displacement or velocity cannot "
                "be told from it; measure acceleration, measure relative to the base, or give the base displacement."
            )

    def state_space(self, mass, damping, stiffness, measured, time_unit):
        xp = namespace(mass, damping, stiffness, self.direction)
        A, A21, A22 = _core(mass, damping, stiffness, time_unit)
        dofs = mass.shape[0]
        B2 = -self.direction * time_unit**2
        none = xp.zeros_like(B2)
        eye = xp.eye(dofs)
        zero = xp.zeros((dofs, dofs))
        C, D = _outputs(
            (xp.hstack([eye, zero]), none),
            (xp.hstack([zero, eye]), none),
            (xp.hstack([A21, A22]), B2 if self.relative else none),
            measured,
            time_unit,
        )
        return StateSpace(A, xp.vstack([none, B2]), C, D)


class BaseDisplacement(AbstractDrive):
    """Measured base displacement x: M q̈ + D (q̇ − r ẋ) + K (q − r x) = 0.

    The state is (q, q̇ − M⁻¹ D r x), which needs no derivative of the input.

    **Arguments:** `direction` (r, dofs × inputs), as for `BaseAcceleration`; `relative`: whether the outputs
    are q − r x. Acceleration, and relative velocity, would need a derivative of the input.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> drive = jaxgray.BaseDisplacement(np.ones((2, 1)))
        >>> model = jaxgray.MechanicalModel(np.eye(2), np.eye(2), 100 * np.eye(2), drive=drive)
        >>> still = model.simulate(np.ones((5000, 1)), 0.01)[-1]  # long after, both stand where the base does
        >>> np.asarray(still).round(6)
        array([1., 1.])
    """

    direction: Float[Array, "dofs inputs"]
    relative: bool = eqx.field(static=True, default=False)

    @property
    def inputs(self):
        return self.direction.shape[1]

    def scaled(self, coordinates, inputs, sampling_time):
        return BaseDisplacement(self.direction * inputs[None, :] / coordinates[:, None], self.relative)

    def check(self, dofs, measured):
        if any(kind == "acceleration" or (self.relative and kind == "velocity") for kind in measured):
            raise ValueError(
                f"measured={measured} with a measured base displacement would need the input's derivatives; "
                "measure displacement (or absolute velocity), or give the base acceleration."
            )

    def state_space(self, mass, damping, stiffness, measured, time_unit):
        xp = namespace(mass, damping, stiffness, self.direction)
        A, A21, A22 = _core(mass, damping, stiffness, time_unit)
        dofs = mass.shape[0]
        to_position = -A22 @ self.direction
        to_speed = A22 @ A22 @ self.direction * -1.0 - A21 @ self.direction
        none = xp.zeros_like(to_position)
        eye = xp.eye(dofs)
        zero = xp.zeros((dofs, dofs))
        C, D = _outputs(
            (xp.hstack([eye, zero]), -self.direction if self.relative else none),
            (xp.hstack([zero, eye]), to_position),
            (xp.hstack([A21, A22]), none),
            measured,
            time_unit,
        )
        return StateSpace(A, xp.vstack([to_position, to_speed]), C, D)
