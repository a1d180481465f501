"""One round of the diagnosis: what is left of a model's free run, and what would explain it."""

import weakref
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import AbstractEffect, AbstractOutputEffect, Place, Term
from ...mechanics.runs.extended import Plant, input_matrix_of
from ...mechanics.runs.linearized import Linearized
from ...mechanics.systems.statespace import StateSpace, sampled
from ...numerics.programs.stored_programs import ONCE, stored
from ..model.candidate import Candidate, Data
from ..model.own_laws import ParameterError, parameter_errors, wrong_number
from ..model.reversals import accelerations, beside_reversals, decided_residual
from ..model.simulator import Simulator
from ..noise.smoother import smoothed_states
from ..noise.whitening import NoiseModel, counted, estimate_noise_model
from .features import Features, Motion, Shape, features
from .scales import scales_at
from .score_test import Screening, screen
from .spectral_lines import lines_of


@dataclass(frozen=True, eq=False)
class Stage:
    """A model on the estimation record: residual, sensitivities and the means to look further.

    `candidate`; `e`, `J`; `plant`; `system`: sampled, outputs that are measured; `force`: mean square of each input;
    `motion`: simulated; `ruled_out`: effects and places that are not looked for; `own`: laws of the user's own model,
    `slopes`: sensitivities to their numbers; `simulator`: what the candidate was simulated with.
    """

    candidate: Candidate
    e: Float[np.ndarray, "samples outputs"]
    J: Float[np.ndarray, "samples outputs parameters"]
    plant: Plant
    system: StateSpace
    force: Float[np.ndarray, " inputs"]
    motion: Motion
    ruled_out: frozenset = frozenset()
    own: tuple[Term, ...] = ()
    slopes: Float[np.ndarray, "samples outputs numbers"] | None = None
    simulator: Simulator | None = None

    @property
    def taken(self) -> frozenset:
        """Effects and places that are in the model."""
        return frozenset((t.effect.id, t.place.name) for t in (*self.own, *self.candidate.terms))


def stage_of(simulator: Simulator, candidate: Candidate, data: Data, record: int = 0) -> Stage:
    """Simulate a candidate and gather what a round needs."""
    y, J, slopes = simulator.run_and_slopes(candidate, data, record)
    e, both = decided_residual(simulator, candidate, data, y, np.concatenate([J, slopes], axis=2), record)
    J, slopes = np.split(both, [J.shape[2]], axis=2)
    plant = simulator.plant(candidate)
    q, v = simulator.motion(candidate, data, record)
    system = sampled_plant(plant, data, simulator.setup.outputs)
    force = simulator.input_power(data)
    motion, own = Motion(q, v, y), simulator.setup.own
    return Stage(candidate, e, J, plant, system, force, motion, own=own, slopes=slopes, simulator=simulator)


@stored(level=ONCE)
def _sampled(plant: Plant, time, hold: str) -> StateSpace:
    continuous = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, time)
    return sampled(continuous, 1.0, hold)


def sampled_plant(plant: Plant, data: Data, outputs: int) -> StateSpace:
    """The linear part at its sampling instants, with the outputs that are measured."""
    system = _sampled(plant, data.traced_sampling_time, data.hold)
    return StateSpace(system.A, system.B, system.C[:outputs], system.D[:outputs])


def screen_simulated(
    stage: Stage,
    data: Data,
    catalogue: tuple[AbstractEffect, ...],
    names: tuple[tuple[str, ...], tuple[str, ...]],
    *,
    noise_model: NoiseModel | None = None,
    surrogates: int = 100,
    rng: np.random.Generator | None = None,
) -> Screening:
    """The gate: every candidate with features from the simulated motion."""
    made = _features(stage, stage.motion, data, catalogue, names)
    return screen(stage.e, stage.J, data, made, stage.system, stage.force, noise_model, surrogates=surrogates, rng=rng)


def screen_smoothed(
    stage: Stage,
    data: Data,
    catalogue: tuple[AbstractEffect, ...],
    names: tuple[tuple[str, ...], tuple[str, ...]],
    noise_model: NoiseModel | None = None,
) -> Screening:
    """The ranking: candidates with features from the measured motion, smoothed; the noise model is begun anew without
    one."""
    motion = measured_motion(stage, data)
    made = _features(stage, motion, data, catalogue, names)
    rounds = 3 if noise_model is None else 1
    return screen(stage.e, stage.J, data, made, stage.system, stage.force, noise_model, rounds=rounds)


def _features(stage: Stage, motion: Motion, data: Data, catalogue, names) -> Features:
    inputs, outputs = names
    hidden = stage.simulator.setup.unmeasured if stage.simulator is not None else ()
    scales = scales_at(stage.plant, motion, data, inputs, outputs, lines_of(stage.e, data), hidden)
    errors = [effect for effect in catalogue if isinstance(effect, ParameterError)]
    others = tuple(effect for effect in catalogue if not isinstance(effect, ParameterError))
    known = stage.taken | stage.ruled_out
    made = features(
        stage.plant, motion, data, others, scales, inputs, outputs, known, hidden=hidden, run=run_about(stage, data)
    )
    made = _where_decided(stage, as_answered(stage, made, data), data)
    shapes, columns, column = [], [], {error.at: k for k, error in enumerate(parameter_errors(stage.own))}
    for effect in errors:
        owner = stage.own[effect.at[0]].place
        place = Place(wrong_number(effect, stage.own), owner.first, owner.second)
        if (effect.id, place.name) not in known:
            one = np.ones(1)
            shapes.append(Shape(effect, place, one, (one,), scales["coordinate", outputs[0]], len(errors)))
            columns.append(column[effect.at])
    if not shapes:
        return made
    responses = np.concatenate([made.responses, np.moveaxis(stage.slopes[:, :, columns], 2, 0)])
    return Features((*made.shapes, *shapes), responses)


def _where_decided(stage: Stage, made: Features, data: Data) -> Features:
    """Features without the samples of accelerometers beside reversals, where a small force moves a jump in time: a peak
    that says how often friction turns, and nothing of the force."""
    near = None if stage.simulator is None else beside_reversals(stage.simulator, stage.candidate, data)
    if near is None:
        return made
    left_out = near[:, None] & accelerations(stage.simulator)[: made.responses.shape[2]]
    return Features(made.shapes, np.where(left_out, 0.0, made.responses))


_runs: "weakref.WeakKeyDictionary[Stage, tuple[Data, Linearized | None]]" = weakref.WeakKeyDictionary()


def run_about(stage: Stage, data: Data) -> Linearized | None:
    """The run of a stage linearised about itself, made once; None where the plant alone answers as it does."""
    if stage.simulator is None or type(stage.simulator).answered is not Simulator.answered:
        return None
    known = _runs.get(stage)
    if known is None or known[0] is not data:
        _runs[stage] = known = data, stage.simulator.linearized(stage.candidate, data)
    return known[1]


def as_answered(stage: Stage, made: Features, data: Data) -> Features:
    """Features as what was simulated answers to them: all but those of the sensors go through the plant."""
    sensed = [isinstance(shape.effect, AbstractOutputEffect) for shape in made.shapes for _ in shape.basis]
    rows = ~np.array(sensed, bool)
    if stage.simulator is None or type(stage.simulator).answered is Simulator.answered or not np.any(rows):
        return made
    responses = made.responses.copy()
    responses[rows] = stage.simulator.answered(stage.plant, responses[rows], data)
    return Features(made.shapes, responses)


_measured: "weakref.WeakKeyDictionary[Stage, tuple[Data, Motion]]" = weakref.WeakKeyDictionary()


def measured_motion(stage: Stage, data: Data) -> Motion:
    """The measured motion, smoothed: the simulated one and what the residual says of the states; made once a stage."""
    known = _measured.get(stage)
    if known is None or known[0] is not data:
        _measured[stage] = known = data, _smoothed(stage, data)
    return known[1]


def _smoothed(stage: Stage, data: Data) -> Motion:
    plant, h = stage.plant, data.sampling_time
    dofs = plant.mass.shape[0]
    push = np.linalg.solve(np.asarray(plant.mass), np.eye(dofs)) * h**2
    B = np.concatenate([np.zeros_like(push), push])
    outputs = stage.system.C.shape[0]
    accelerated = np.array([kind == "acceleration" for kind in plant.measured[:outputs]])
    D = np.where(accelerated[:, None], push[:outputs] / h**2, 0.0)
    Bd = _held(np.asarray(plant_matrix(plant, h)), B)
    system = StateSpace(stage.system.A, Bd, stage.system.C, D)
    map_ = np.asarray(input_matrix_of(plant.drive))
    force = np.mean((data.u[: data.samples] @ map_.T) ** 2, axis=0)
    force = np.maximum(force, 1e-6 * max(float(force.max()), 1e-300))
    # The mean is no motion: a constant would drag the smoothed states along.
    noise_model = estimate_noise_model(stage.e, data.kept, system, force)
    ratio = noise_model.ratio if noise_model.ratio > 0 else 1e-8
    x = smoothed_states(system, stage.e, data.kept, force, ratio)
    q, v = stage.motion.q + x[:, :dofs], stage.motion.v + x[:, dofs:] / h
    if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
        return stage.motion
    # Outputs stay simulated: made from measured ones, features of the sensors would share the residual's noise.
    return Motion(q, v, stage.motion.y)


def plant_matrix(plant: Plant, h: float):
    """A of the first-order form, time in units of `h` [s]."""
    return plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, h).A


def _held(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """B of a zero-order hold over one unit of time."""
    import scipy.linalg

    states, inputs = B.shape
    block = np.zeros((states + inputs, states + inputs))
    block[:states, :states], block[:states, states:] = A, B
    return scipy.linalg.expm(block)[:states, states:]


def rows_of(data: Data) -> int:
    """Output samples that count."""
    return int(counted(data.kept).sum())
