"""The mechanical model M q̈ + D q̇ + K q = u."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.programs.runtime import ready
from .systems.abstract_model import AbstractMechanicalModel
from .systems.drives import ORDER, AbstractDrive, Force


def _matrix(value, name: str) -> Array:
    X = value if hasattr(value, "aval") else jax.device_put(np.atleast_2d(np.array(value, dtype=float)))
    if X.ndim != 2 or X.shape[0] != X.shape[1]:
        raise ValueError(f"{name} has shape {tuple(X.shape)}; give a square matrix, one row per coordinate.")
    return X


def hidden_names(hidden) -> tuple[str, ...]:
    """Names of hidden coordinates: as given, or h1, h2, … of so many.

    **Raises:** `ValueError` for anything but texts or a whole number.
    """
    if isinstance(hidden, int | np.integer) and not isinstance(hidden, bool) and hidden >= 0:
        return tuple(f"h{k + 1}" for k in range(hidden))
    names = hidden if isinstance(hidden, tuple | list) else None
    if names is None or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"hidden={hidden!r} is not understood; give how many coordinates are hidden, or their names.")
    return tuple(names)


class MechanicalModel(AbstractMechanicalModel):
    """A linear mechanical system in continuous time, in the units of the record it came from.

    M q̈ + D q̇ + K q = E u, output k measuring coordinate k; coordinates beyond the outputs are hidden.

    **Arguments:** `mass`, `damping`, `stiffness` (dofs × dofs, symmetric); `drive`: how the input enters
    (default: input j is a force on coordinate j); `measured`: "displacement", "velocity" or "acceleration",
    one for all outputs or one per output; `input_names`, `output_names`, `input_units`, `output_units`;
    `effects`: what `simulate` adds to the linear model; modes, zeros, responses and `state_space` are of the linear
    part; `hidden`: how many coordinates, the last ones, no output measures, or their names (default none; h1, h2, …).

    **Raises:** `ValueError` when shapes or names do not fit together.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> M, D = np.diag([2.0, 1.0]), np.diag([3.0, 1.0])
        >>> K = np.array([[80.0, -40.0], [-40.0, 40.0]])
        >>> model = jaxgray.MechanicalModel(M, D, K, drive=jaxgray.Force(np.array([[1.0], [0.0]])))
        >>> model.modes().natural_frequency_hz.round(3)
        array([0.545, 1.315])
        >>> model.simulate(np.ones((500, 1)), 0.01).shape
        (500, 2)
    """

    mass: Float[Array, "dofs dofs"]
    damping: Float[Array, "dofs dofs"]
    stiffness: Float[Array, "dofs dofs"]
    drive: AbstractDrive
    measured: tuple[str, ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    input_units: tuple[str, ...] = eqx.field(static=True)
    output_units: tuple[str, ...] = eqx.field(static=True)
    effects: tuple
    hidden: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        mass,
        damping,
        stiffness,
        *,
        drive: AbstractDrive | None = None,
        measured="displacement",
        input_names=None,
        output_names=None,
        input_units=None,
        output_units=None,
        effects=(),
        hidden=(),
    ):
        ready()
        self.mass = _matrix(mass, "mass")
        self.damping = _matrix(damping, "damping")
        self.stiffness = _matrix(stiffness, "stiffness")
        self.hidden = hidden_names(hidden)
        dofs = self.mass.shape[0]
        outputs = max(dofs - len(self.hidden), 0)
        self.drive = Force(jnp.eye(dofs, outputs)) if drive is None else drive
        self.measured = (measured,) * outputs if isinstance(measured, str) else tuple(measured)
        inputs = self.drive.inputs
        self.input_names = tuple(input_names or (f"u{k + 1}" for k in range(inputs)))
        self.output_names = tuple(output_names or (f"y{k + 1}" for k in range(outputs)))
        self.input_units = tuple(input_units or ("",) * inputs)
        self.output_units = tuple(output_units or ("",) * outputs)
        self.effects = tuple(effects)

    def __check_init__(self):
        dofs = self.mass.shape[0]
        for name in ("damping", "stiffness"):
            if getattr(self, name).shape != self.mass.shape:
                raise ValueError(
                    f"{name} has shape {tuple(getattr(self, name).shape)}, mass has {tuple(self.mass.shape)}; "
                    "give all three for the same coordinates."
                )
        outputs = dofs - len(self.hidden)
        if outputs < 1:
            raise ValueError(f"hidden={self.hidden} leaves no coordinate of {dofs} for an output; name fewer.")
        if len(self.measured) != outputs or any(kind not in ORDER for kind in self.measured):
            raise ValueError(
                f"measured={self.measured} does not say displacement, velocity or acceleration for each of the "
                f"{outputs} {'measured ' * bool(self.hidden)}coordinates."
            )
        self.drive.check(dofs, self.measured)
        for name, wanted in (
            ("input_names", self.drive.inputs),
            ("input_units", self.drive.inputs),
            ("output_names", outputs),
            ("output_units", outputs),
        ):
            if len(getattr(self, name)) != wanted:
                raise ValueError(f"{name}={getattr(self, name)} has {len(getattr(self, name))} entries, not {wanted}.")
        if len(set(self.coordinates)) < len(self.coordinates) and self.hidden:
            raise ValueError(f"hidden={self.hidden} repeats a name; coordinates are {', '.join(self.coordinates)}.")

    def with_matrices(self, mass, damping, stiffness) -> "MechanicalModel":
        """The same model with other matrices."""
        return dataclasses.replace(
            self,
            mass=_matrix(mass, "mass"),
            damping=_matrix(damping, "damping"),
            stiffness=_matrix(stiffness, "stiffness"),
        )

    def simulate(self, u, sampling_time=None, *, hold=None, x0=None, offset=None, scheduling=None, substeps=1):
        """Free-run simulation.

        **Arguments:** `u`: a `Record`, of which the inputs, sampling time and hold are taken, or inputs
        (samples × inputs); `sampling_time` [s], only without a record; `hold`: default the record's, or
        "zero"; `x0`, `offset`, `scheduling` (default the record's), `substeps`: as for
        `jaxgray.mechanics.runs.simulate.simulate`.

        **Returns:** the outputs (samples × outputs).

        **Raises:** `ValueError` where an argument does not fit; `ComputationError` where the outputs grow
        without bound.
        """
        from .runs.simulate import signals_of, simulate

        scheduling = getattr(u, "scheduling", None) if scheduling is None else scheduling
        u, _, sampling_time, hold = signals_of(u, None, sampling_time, hold)
        return simulate(
            self, u, sampling_time, hold=hold, x0=x0, offset=offset, scheduling=scheduling, substeps=substeps
        )

    def predict(
        self,
        u,
        y=None,
        sampling_time=None,
        *,
        hold=None,
        x0=None,
        offset=None,
        force_noise_ratio=0.0,
        output_noise=None,
    ):
        """One-step prediction, of linear models only; with `force_noise_ratio` 0 it is the free run, of any model.

        **Arguments:** `u`: a `Record`, or inputs; `y`, `sampling_time` [s]: only without a record; `hold`:
        default the record's, or "zero"; `x0`, `offset`, `force_noise_ratio`, `output_noise`: as for
        `jaxgray.mechanics.runs.simulate.predict`.

        **Returns:** the predicted outputs (samples × outputs).

        **Raises:** as `simulate`, and `ValueError` where the model has effects and noise at the inputs is asked for.
        """
        from .runs.simulate import predict, signals_of

        noise = {"scheduling": getattr(u, "scheduling", None)}
        u, y, sampling_time, hold = signals_of(u, y, sampling_time, hold)
        noise |= {"force_noise_ratio": force_noise_ratio, "output_noise": output_noise}
        return predict(self, u, y, sampling_time, hold=hold, x0=x0, offset=offset, **noise)

    def modes(self):
        """Natural frequencies, damping ratios, mode shapes and poles, as `Modes`."""
        from .systems.modal import modes

        return modes(self)

    def zeros(self, *, input=None, output=None):
        """Transmission zeros, or those from one input to one output, with antiresonances in Hz.

        **Arguments:** `input`, `output`: name or position; both or neither.

        **Returns:** `Zeros`.

        **Raises:** `ValueError` when only one is given, or where there are no zeros to speak of.
        """
        from .systems.zeros import transmission_zeros, zeros

        if input is None and output is None:
            return transmission_zeros(self)
        return zeros(self, input=input, output=output)

    def frequency_response(self, omega, *, kind="receptance"):
        """Frequency-response function of the measured coordinates.

        **Arguments:** `omega`: frequencies [rad/s]; `kind`: "receptance" (default), "mobility" or
        "accelerance".

        **Returns:** complex, frequencies × outputs × inputs.

        **Raises:** `ValueError` for another kind or bad frequencies.
        """
        from .systems.modal import frequency_response

        return frequency_response(self, omega, kind=kind)

    def __repr__(self) -> str:
        from .describe import describe

        return describe(self)
