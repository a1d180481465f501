"""Where the work of the inputs goes: into motion and springs, dampers, and the laws of a model.

Multiplied by the velocities, M q̈ + D q̇ + K q + Σ b f = F says how the energy changes:

    ∫ q̇ᵀF dt = Δ(½ q̇ᵀM q̇ + ½ qᵀK q) + ∫ q̇ᵀD q̇ dt + ∫ q̇ᵀK_a q dt + Σ ∫ f bᵀq̇ dt,

with K_a the antisymmetric part of K, which stores nothing; that of D does no work. Every term is computed by itself,
from the simulated motion and the forces that the laws have there: what is missing for the two sides to be equal is the
error of the integration.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..numerics.matrices.bounded import bounded
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.programs.stored_programs import ONCE, stored
from ..records import Record, record_of
from .effects.base import AbstractForceEffect, Term
from .model import MechanicalModel
from .runs.extended import (
    changed_input,
    changed_plant,
    held_input,
    input_matrix_of,
    plant_states,
    slots_of,
    with_coordinates_at_rest,
)
from .systems.drives import BaseDisplacement, Force
from .systems.step_rows import Plant, local_rows
from .systems.units import composed_unit, displacement_unit

TURNED = 0.1
"""Angle that the fastest mode turns in a step at most, and share of itself by which the fastest decay falls."""

MOST_STEPS = 64
"""Steps per sample at most."""

MOST_ROWS = 1_000_000
"""Steps at most: of a longer record the first part is followed, in some 100 MB."""

CREATED = 0.02
"""Share of what a law moves back and forth that it must give, net, to be said to create energy."""

SWINGS = 1.5
"""Largest gain and loss within a cycle that it must give as well: so much may be stored when the cycles end."""


@dataclass(frozen=True)
class LawEnergy:
    """What a law of the model takes out of the motion.

    `effect`, `place`; `work`: taken over the whole record, negative where given; `over_cycles`: taken between the first
    and the last time that its own deflection passes its median upwards, and `cycles` how many lie between; `moved`:
    what it took and gave there together; `swing`: the largest gain and loss within one cycle; `outside`: whether it
    stands for something that acts from outside (a disturbance, a change over time, an input).
    """

    effect: str
    place: str
    work: float
    over_cycles: float
    cycles: int
    moved: float
    swing: float
    outside: bool

    @property
    def creates(self) -> bool:
        """Whether it gives more over whole cycles than it can have stored, with nothing from outside to take it from:
        negative friction, a spring that pushes harder than it was pressed."""
        return not self.outside and self.over_cycles < -max(CREATED * self.moved, SWINGS * self.swing)


@dataclass(frozen=True)
class EnergyBalance:
    """Work of the inputs on a model's motion over a record, and where it went.

    `supplied`: work of the inputs; `stored`: rise of the kinetic energy and that of the springs of K; `damped`: taken
    by D; `circulated`: taken by what of K is not symmetric; `laws`, in the order of the model's forces; `unit` of all,
    empty where none can be said. Under a measured base acceleration the motion is that relative to the base, and the
    input the inertia force.
    """

    supplied: float
    stored: float
    damped: float
    circulated: float
    laws: tuple[LawEnergy, ...]
    unit: str

    @property
    def _taken(self) -> tuple[float, ...]:
        return (self.stored, self.damped, self.circulated, *(law.work for law in self.laws))

    @property
    def entered(self) -> float:
        """All that came into the motion, from wherever."""
        return max(self.supplied, 0.0) - sum(min(work, 0.0) for work in self._taken)

    @property
    def residual(self) -> float:
        """What is missing in the balance: the error of the integration."""
        return self.supplied - sum(self._taken)

    @property
    def error(self) -> float:
        """The residual as a share of all that came in; 0 where nothing did."""
        return abs(self.residual) / self.entered if self.entered > 0 else 0.0


def energy_balance(model: MechanicalModel, record: Record, *, x0=None) -> EnergyBalance:
    """Work of a record's inputs on a model, its effects included, and where that energy went.

    **Arguments:** `model`; `record`, of which inputs, sampling time, hold and scheduling are taken; `x0`:
    displacements, then velocities of the coordinates at the first sample; default at rest.

    **Returns:** an `EnergyBalance`; only of the first part where a record would take more than a million integration
    steps (two a sample, more where the fastest mode has few samples in a period).

    **Raises:** `ValueError` where the input is a measured base displacement, whose work takes the force on the base,
    or where the arguments do not fit; `ComputationError` where the motion grows without bound.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> found = jaxgray.energy_balance(model, record)
        >>> bool(found.error < 1e-6), bool(found.damped > 0)
        (True, True)
    """
    if isinstance(model.drive, BaseDisplacement):
        raise ValueError("model is driven by a base displacement, whose work no record shows; give forces.")
    if record_of(record, "record").inputs != model.inputs:
        raise ValueError(f"record has {record.inputs} inputs, the model has {model.inputs}; give one for each.")
    state = np.zeros(2 * model.dofs) if x0 is None else np.ravel(np.asarray(x0, dtype=float))
    if state.shape != (2 * model.dofs,) or not np.isfinite(state).all():
        raise ValueError(f"x0 is {x0}; give {2 * model.dofs} finite numbers: displacements, then velocities.")
    h, steps = record.sampling_time, steps_per_sample(model, record.sampling_time)
    record = record[: max(MOST_ROWS // steps, 3)]
    p = np.zeros(record.samples) if record.scheduling is None else record.scheduling
    found = _followed(model, state, record.u, np.asarray(h), p, record.hold, steps)
    matrices, motion, forces, slots = (tuple(np.asarray(X) for X in part) for part in found)
    if not bounded(*motion):
        raise ComputationError(RESULTS.nonfinite, stage="simulation", detail="the motion grows without bound")
    last = (record.samples - 1) * steps
    terms = [term for term in model.effects if isinstance(term.effect, AbstractForceEffect)]
    return _accounted(matrices, motion, forces, slots, terms, h / steps, last, _unit(model))


def steps_per_sample(model: MechanicalModel, sampling_time: float) -> int:
    """Even number of steps per sample [sampling_time in s] that follow the fastest of the model's modes."""
    A = model.drive.state_space(*map(np.asarray, (model.mass, model.damping, model.stiffness)), model.measured, 1.0).A
    fastest = float(np.max(np.abs(np.linalg.eigvals(np.asarray(A))))) * sampling_time
    return int(min(2 * max(np.ceil(fastest / TURNED / 2), 1), MOST_STEPS))


@stored(level=ONCE)
def _followed(model, x0, u, sampling_time, scheduling, hold, steps):
    """Matrices with the model's terms; displacements and velocities; forces of the inputs at start and end; arms and
    forces of the laws: all of these at every step."""
    plant = Plant(model.mass, model.damping, model.stiffness, model.drive, model.measured)
    start, end, _ = changed_input(model.effects, *held_input(u, hold), u, sampling_time)
    plant, h = changed_plant(plant, model.effects), sampling_time / steps
    start, end = _finer(start, end, steps)
    p, _ = _finer(scheduling, jnp.append(scheduling[1:], scheduling[-1]), steps)
    laws = tuple(dict.fromkeys(t.effect for t in model.effects if isinstance(t.effect, AbstractForceEffect)))
    slots = slots_of(model.effects, plant, laws)
    dofs = plant.mass.shape[0]
    state = with_coordinates_at_rest(x0, dofs)
    x, f, _ = plant_states(plant, state, start, end, slots, h, laws=laws, scheduling=p)
    C, D = local_rows(plant, jnp.eye(dofs), h)
    q, v = (x @ C[k].T + start @ D[k].T for k in (0, 1))
    E = input_matrix_of(plant.drive)
    E = E if isinstance(plant.drive, Force) else -plant.mass @ E
    arms = jnp.zeros((0, dofs)) if slots is None else slots.arms
    f = jnp.zeros((len(x), 0)) if f is None else f
    return (plant.mass, plant.damping, plant.stiffness), (q, v), (start @ E.T, end @ E.T), (arms, f)


def _finer(start, end, steps: int):
    """Values at start and end of every step, of series that run straight over every sample."""
    part = jnp.arange(steps).reshape(1, -1, *(1,) * (start.ndim - 1)) / steps
    rise = (end - start)[:, None]
    first = start[:, None] + part * rise
    return (X.reshape(-1, *start.shape[1:]) for X in (first, first + rise / steps))


def _accounted(matrices, motion, forces, slots, terms: list[Term], h: float, last: int, unit: str) -> EnergyBalance:
    M, D, K = matrices
    (q, v), (begin, end), (arms, f) = motion, forces, slots
    even, odd = slice(0, last + 1, 2), slice(1, last + 1, 2)

    def integral(power, at_end=None):
        """Work by Simpson's rule over every two steps; `at_end`: power at the end of steps, where it may jump."""
        after = power[2 : last + 1 : 2] if at_end is None else at_end[odd]
        return h / 3 * (power[even][:-1] + 4 * power[odd] + after)

    def energy(k):
        return (v[k] @ M @ v[k] + q[k] @ K @ q[k]) / 2

    def taken(k):
        power = f[:, k] * np.sum(v * arms[k], axis=1)
        # With the input or the acceleration it jumps at the end of a sample, where one of both values is known alone.
        return 2 * h * power[odd] if _may_jump(terms[k].effect) else integral(power)

    along = q @ arms.T
    pushed = np.sum(np.roll(v, -1, axis=0) * end, axis=1)
    return EnergyBalance(
        float(np.sum(integral(np.sum(v * begin, axis=1), pushed))),
        float(energy(last) - energy(0)),
        float(np.sum(integral(np.einsum("ni,ij,nj->n", v, D, v)))),
        float(np.sum(integral(np.einsum("ni,ij,nj->n", v, (K - K.T) / 2, q)))),
        tuple(_of_law(term, along[even, k], taken(k)) for k, term in enumerate(terms)),
        unit,
    )


def _may_jump(effect: AbstractForceEffect) -> bool:
    return effect.places == "input" or effect.alters[:1] == ("mass",)


def _of_law(term: Term, deflection: Float[np.ndarray, " nodes"], work: Float[np.ndarray, " steps"]) -> LawEnergy:
    """What a law takes, by its deflection at the nodes and the work between them."""
    total = np.concatenate([[0.0], np.cumsum(work)])
    beyond = deflection - np.median(deflection)
    up = np.flatnonzero((beyond[:-1] < 0) & (beyond[1:] >= 0))
    effect = term.effect
    outside = effect.tied_to_clock or effect.scheduled or effect.places == "input"
    if len(up) < 2:
        return LawEnergy(effect.id, term.place.name, float(total[-1]), 0.0, 0, 0.0, 0.0, outside)
    part = beyond[up] / (beyond[up] - beyond[up + 1])
    passed = total[up] + part * work[up]
    swing = max(float(np.ptp(total[a : b + 1])) for a, b in zip(up[:-1], up[1:] + 1))
    moved = float(np.sum(np.abs(work[up[0] : up[-1]])))
    over = float(passed[-1] - passed[0])
    return LawEnergy(effect.id, term.place.name, float(total[-1]), over, len(up) - 1, moved, swing, outside)


def _unit(model: MechanicalModel) -> str:
    lengths = {displacement_unit(unit, kind) for unit, kind in zip(model.output_units, model.measured)}
    if len(lengths) != 1 or len(set(model.input_units)) != 1:
        return ""
    return composed_unit((1, 1, 0), model.input_units[0], *lengths, per_mass=not isinstance(model.drive, Force))
