"""What each candidate would add to the outputs, to first order: one response per effect, place and shape.

Forces are computed from a motion (simulated, or smoothed from the measurement) and sent through the model linearised
about its free run, which without laws is the linear plant; input effects likewise from the input; output effects from
the outputs; matrix effects as differences of linear runs.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import (
    AbstractEffect,
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Local,
    Place,
    Scales,
    Term,
    places_of,
)
from ...mechanics.runs.extended import Plant, arm_of, held_input, input_matrix_of, local_rows, with_coordinates
from ...mechanics.runs.force_over_time import force_over_time
from ...mechanics.runs.linearized import Linearized, answers
from ...mechanics.systems.drives import Force
from ...mechanics.systems.statespace import hold_matrices
from ...numerics.matrices.bounded import bounded
from ...numerics.programs.side_by_side import side_by_side
from ...numerics.programs.stored_programs import ONCE, stored
from ...numerics.responses.lifting import respond
from ..model.candidate import Data
from ..model.simulator import ended

BATCH = 16
"""Responses are computed in multiples of so many, so that little is compiled."""

SIDE_BY_SIDE = 32
"""The same for those of a linearised run, which goes sample by sample."""


@dataclass(frozen=True)
class Motion:
    """Displacements, velocities and outputs from which features are made, padded like the record."""

    q: Float[np.ndarray, "samples dofs"]
    v: Float[np.ndarray, "samples dofs"]
    y: Float[np.ndarray, "samples outputs"]


@dataclass(frozen=True)
class Shape:
    """One candidate with one choice of shape: an effect at a place, and the responses that it can make.

    `values`: the shape's parameter vector; `basis`: parameter vectors whose responses span it; `tried`: number of
    shapes and places among which it was chosen.
    """

    effect: AbstractEffect
    place: Place
    values: np.ndarray
    basis: tuple[np.ndarray, ...]
    scales: Scales
    tried: int

    @property
    def free(self) -> int:
        """Estimated parameters."""
        return _counted(type(self.effect))

    def term(self, weights: np.ndarray) -> Term:
        """The term that the responses with these weights stand for."""
        values = self.effect.combine(self.values, weights)
        return Term(self.effect, self.place, self.effect.bounded(values))


@functools.cache
def _counted(law: type[AbstractEffect]) -> int:
    return sum(parameter.counts for parameter in law.parameters)


@dataclass(frozen=True)
class Features:
    """Responses of all shapes, one a row, in the order of the shapes."""

    shapes: tuple[Shape, ...]
    responses: Float[np.ndarray, "columns samples outputs"]

    def only(self, scores) -> "Features":
        """Those of some scores."""
        columns = [np.arange(s.column, s.column + len(s.shape.basis)) for s in scores]
        rows = np.concatenate(columns) if columns else np.zeros(0, int)
        return Features(tuple(s.shape for s in scores), self.responses[rows])


def features(
    plant: Plant,
    motion: Motion,
    data: Data,
    catalogue: tuple[AbstractEffect, ...],
    scales: dict[tuple[str, str], Scales],
    input_names: tuple[str, ...],
    output_names: tuple[str, ...],
    taken: frozenset = frozenset(),
    shapes: dict | None = None,
    hidden: tuple[str, ...] = (),
    run: Linearized | None = None,
) -> Features:
    """Responses of every effect at every place, with every shape of its grid.

    **Arguments:** `plant`: the linear part; `motion`; `data`: the record; `catalogue`; `scales`: by kind of place and
    name; `input_names`, `output_names`; `taken`: (id, place) that are in the model already; `shapes`: parameter
    vectors to try instead of the effect's own, by (id, place); `hidden`: names of the coordinates that no output
    measures; `run`: what answers to forces and inputs in the place of the plant.

    **Returns:** `Features`.
    """
    all_shapes, groups = [], {}
    outputs = len(output_names)
    for effect in catalogue:
        if _kind(effect) == "force" and effect.places == "input" and not isinstance(plant.drive, Force):
            # An acceleration of the base is no force that is transmitted.
            continue
        if effect.scheduled and not np.any(data.scheduling):
            continue
        everywhere = places_of(effect, input_names, output_names, hidden)
        places = [p for p in everywhere if (effect.id, p.name) not in taken]
        for place in places:
            here = scales[_scale_key(effect, place, output_names)]
            if shapes is not None and (effect.id, place.name) not in shapes:
                continue
            grid = effect.shapes(here) if shapes is None else shapes[effect.id, place.name]
            tried = effect.looks(here, grid) * len(places)
            kind = _kind(effect)
            group = groups.setdefault((kind, place.name if kind != "matrix" else effect.extra), [])
            group.extend(range(len(all_shapes), len(all_shapes) + len(grid)))
            for values in grid:
                basis = tuple(effect.basis(values))
                all_shapes.append(Shape(effect, place, np.asarray(values, float), basis, here, tried))
    samples = len(data.u)
    first = np.concatenate([[0], np.cumsum([len(s.basis) for s in all_shapes])])[:-1]
    responses = np.empty((sum(len(s.basis) for s in all_shapes), samples, outputs))

    def make(group) -> None:
        (kind, _), members = group
        made = _MAKERS[kind]([all_shapes[k] for k in members], plant, motion, data, outputs, run)
        columns = np.concatenate([np.arange(first[k], first[k] + len(all_shapes[k].basis)) for k in members])
        responses[columns] = made

    side_by_side(make, groups.items())
    return Features(tuple(all_shapes), responses)


def _scale_key(effect: AbstractEffect, place: Place, output_names) -> tuple[str, str]:
    if effect.places == "input":
        return "input", place.name
    if isinstance(effect, AbstractOutputEffect):
        return "output", output_names[max(place.first, 0)]
    return "coordinate", place.name


def _kind(effect: AbstractEffect) -> str:
    for kind, family in (
        ("force", AbstractForceEffect),
        ("input", AbstractInputEffect),
        ("matrix", AbstractMatrixEffect),
        ("output", AbstractOutputEffect),
    ):
        if isinstance(effect, family):
            return kind
    raise ValueError(f"{type(effect).__name__} is no effect on force, input, matrix or output; subclass one of them.")


def _columns(shapes):
    """Laws in order of appearance, and the stacked basis vectors of each."""
    laws, vectors = {}, {}
    for s in shapes:
        laws.setdefault(s.effect.id, s.effect)
        vectors.setdefault(s.effect.id, []).extend(s.basis)
    return tuple(laws.values()), [np.stack(vectors[name]) for name in laws]


def _in_order(shapes, laws, results):
    """Columns back in the order of the shapes, from columns law by law."""
    starts = np.concatenate([[0], np.cumsum([len(r) for r in results])])
    at = {law.id: int(start) for law, start in zip(laws, starts)}
    index = []
    for s in shapes:
        name, count = s.effect.id, len(s.basis)
        index += range(at[name], at[name] + count)
        at[name] += count
    return np.array(index, dtype=int)


def forces_of(shapes: list[Shape], plant: Plant, motion: Motion, data: Data) -> Float[np.ndarray, "columns samples"]:
    """Forces over a motion for the basis of every shape, in their order; all shapes at one place."""
    arm = arm_of(Term(shapes[0].effect, shapes[0].place, np.zeros(0)), plant)
    channel = shapes[0].place.first if shapes[0].effect.places == "input" else -1
    laws, vectors = _columns(shapes)
    u = np.zeros(len(data.u)) if channel < 0 else data.u[:, channel]
    here = _seen(motion.q, motion.v, u, data.u, arm, plant, data.traced_sampling_time, data.scheduling)
    series = [_force_series(law, stacked, here, data.traced_sampling_time) for law, stacked in zip(laws, vectors)]
    return np.concatenate([np.asarray(s) for s in series])[_in_order(shapes, laws, series)]


def _force_columns(shapes, plant, motion, data, outputs, run):
    arm = arm_of(Term(shapes[0].effect, shapes[0].place, np.zeros(0)), plant)
    forces = forces_of(shapes, plant, motion, data)
    if run is not None:
        made = _answers(run, -arm, forces, _next(forces), outputs, forced=True)
        if bounded(made[:, : data.samples]):
            return _within(made, data)
    return _responses(
        plant,
        -arm[:, None],
        forces[:, :, None],
        _next(forces)[:, :, None],
        data.traced_sampling_time,
        outputs,
        forced=True,
    )


@stored(level=ONCE)
def _seen(q, v, u, inputs, arm, plant, time, scheduling):
    """What a force law sees of one motion at its place."""
    samples, dofs = q.shape
    C, D = local_rows(plant, jnp.eye(dofs), time)
    a = arm @ (C[2] @ jnp.concatenate([q, v * time], axis=1).T + D[2] @ inputs.T)
    compliance = jnp.broadcast_to(arm @ jnp.linalg.solve(plant.mass, arm), (samples,))
    return Local(q @ arm, v @ arm, a, compliance, u, jnp.arange(samples) * time, scheduling)


@stored
def _force_series(law, vectors, here, time):
    """Force over time of one law for every basis vector; law by law, since which laws are asked for differs."""
    return jax.vmap(lambda p: force_over_time(law, p, here, time))(vectors)


def _next(X):
    """Series shifted to the end of every sample, the last held."""
    return np.concatenate([X[:, 1:], X[:, -1:]], axis=1)


def _responses(plant, columns, start, end, time, outputs, *, forced, seen=None):
    """Outputs of the plant for many inputs: `start`, `end` (columns × samples × channels), added forces or inputs;
    `seen`: those at the samples, None where they are `start`."""
    total = start.shape[0]
    made = np.empty((total, start.shape[1], outputs))
    for k in range(0, total, BATCH):
        part = slice(k, min(k + BATCH, total))
        pad = BATCH - (part.stop - part.start)
        some = [
            None if X is None else np.pad(np.asarray(X)[part], ((0, pad), (0, 0), (0, 0))) for X in (start, end, seen)
        ]
        y = _respond_many(plant, columns, *some, time, forced)
        made[part] = np.asarray(y)[: BATCH - pad, :, :outputs]
    return made


def _within(made: np.ndarray, data: Data) -> np.ndarray:
    """Responses that end with the record where they run away in the padding, each by itself."""
    for k, one in enumerate(made):
        made[k] = ended(data, one)
    return made


def _answers(run: Linearized, column, start, end, outputs, *, forced):
    """Outputs of a linearised run for many series of forces or of one input."""
    total = len(start)
    made = np.empty((total, start.shape[1], outputs))
    for k in range(0, total, SIDE_BY_SIDE):
        part = slice(k, min(k + SIDE_BY_SIDE, total))
        pad = ((0, SIDE_BY_SIDE - (part.stop - part.start)), (0, 0))
        y = _answer_many(run, column, np.pad(start[part], pad), np.pad(end[part], pad), forced)
        made[part] = np.asarray(y)[: part.stop - part.start, :, :outputs]
    return made


@stored
def _answer_many(run, column, start, end, forced):
    return answers(run, column, start, end, forced=forced)


@stored
def _respond_many(plant, columns, start, end, seen, time, forced):
    system = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, time)
    dofs = plant.mass.shape[0]
    if forced:
        push = jnp.linalg.solve(plant.mass, columns)
        B = jnp.concatenate([jnp.zeros_like(push), push * time**2])
        measured = jnp.asarray([kind == "acceleration" for kind in plant.measured])
        D = jnp.where(measured[:, None], push[: len(plant.measured)], 0.0)
    else:
        B, D = system.B @ columns, system.D @ columns
    Ad, B0, B1 = hold_matrices(system.A, B, 1.0, "linear")
    both = jnp.concatenate([start, end], axis=2)
    feed = jnp.concatenate([D, jnp.zeros_like(D)], axis=1)
    state = jnp.zeros(2 * dofs)
    y = jax.vmap(lambda w: respond(Ad, jnp.concatenate([B0, B1], axis=1), system.C, feed, w, state))(both)
    return y if seen is None else y + (seen - start) @ D.T


def _input_columns(shapes, plant, motion, data, outputs, run):
    j = shapes[0].place.first
    laws, vectors = _columns(shapes)
    start, end = held_input(data.u, data.hold)
    # Nothing but an accelerometer sees the input itself.
    direct = "acceleration" in plant.measured
    held = start[:, j], end[:, j], data.traced_sampling_time, direct
    changes = [_input_changes(law, stacked, *held) for law, stacked in zip(laws, vectors)]
    order = _in_order(shapes, laws, [c[0] for c in changes])
    count = 3 if direct else 2
    made = [np.concatenate([np.asarray(c[k]) for c in changes])[order][:, :, None] for k in range(count)]
    column = np.eye(input_matrix_of(plant.drive).shape[1])[:, j : j + 1]
    first, last, seen = (*made, None)[:3]
    if run is not None:
        y = _answers(run, column[:, 0], first[:, :, 0], last[:, :, 0], outputs, forced=False)
        y = y if seen is None else y + (seen - first) * np.asarray(run.fed_input)[:outputs, j]
        if bounded(y[:, : data.samples]):
            return _within(y, data)
    return _responses(plant, column, first, last, data.traced_sampling_time, outputs, forced=False, seen=seen)


@stored
def _input_changes(law, vectors, start, end, time, direct):
    def one(p):
        a, b = law.apply(p, start, end, time)
        both = a - start, b - end
        return (*both, law.at_samples(p, start, end, start, time) - start) if direct else both

    return jax.vmap(one)(vectors)


def _output_columns(shapes, plant, motion, data, outputs, run):
    first = shapes[0].place.first
    made = np.zeros((sum(len(s.basis) for s in shapes), len(data.u), outputs))
    source = np.zeros(len(data.u))
    if shapes[0].place.second >= 0:
        source = np.concatenate([motion.y, data.u], axis=1)[:, shapes[0].place.second]
    laws, vectors = _columns(shapes)
    for k in range(outputs) if first < 0 else (first,):
        seen = motion.y[:, k], source, data.traced_sampling_time
        changes = [_output_changes(law, stacked, *seen) for law, stacked in zip(laws, vectors)]
        made[:, :, k] = np.concatenate([np.asarray(c) for c in changes])[_in_order(shapes, laws, changes)]
    return made


@stored(level=ONCE)
def _output_changes(law, vectors, y, source, time):
    return jax.vmap(lambda p: law.apply(p, y, source, time) - y)(vectors)


def _matrix_columns(shapes, plant, motion, data, outputs, run):
    start, end = held_input(data.u, data.hold)
    laws, vectors = _columns(shapes)
    dofs = plant.mass.shape[0]
    changed = [
        _changed_matrices(law, stacked, *_arms([s for s in shapes if s.effect.id == law.id], dofs), plant)
        for law, stacked in zip(laws, vectors)
    ]
    order = _in_order(shapes, laws, [c[0] for c in changed])
    matrices = [np.concatenate([np.asarray(c[k]) for c in changed])[order] for k in range(3)]
    total = matrices[0].shape[1]
    drive = with_coordinates(plant.drive, total)
    measured = plant.measured + ("displacement",) * (total - dofs)
    held = start, end, data.traced_sampling_time
    made = _linear_outputs(matrices, drive, measured, *held)
    alone = [np.asarray(X)[None] for X in (plant.mass, plant.damping, plant.stiffness)]
    still = _linear_outputs(alone, plant.drive, plant.measured, *held)
    return made[:, :, :outputs] - still[:, :, :outputs]


def _linear_outputs(matrices, drive, measured, *held):
    """Outputs for many mass, damping and stiffness matrices, so many at once that one program serves any number."""
    made = []
    for k in range(0, len(matrices[0]), BATCH):
        part = [X[k : k + BATCH] for X in matrices]
        count = len(part[0])
        part = [np.concatenate([X, np.repeat(X[-1:], BATCH - count, axis=0)]) for X in part]
        made.append(np.asarray(_linear_runs(*part, drive, measured, *held))[:count])
    return np.concatenate(made)


def _arms(shapes, dofs):
    """First and second arm of every basis vector."""
    eye = np.concatenate([np.eye(dofs), np.zeros((1, dofs))])
    first = [s.place.first for s in shapes for _ in s.basis]
    second = [s.place.second for s in shapes for _ in s.basis]
    return eye[first], eye[second]


@stored(level=ONCE)
def _changed_matrices(law, stacked, first, second, plant):
    def one(p, a, b):
        return law.matrices(p, plant.mass, plant.damping, plant.stiffness, a, b)

    return jax.vmap(one)(stacked, first, second)


@stored(level=ONCE)
def _linear_runs(M, D, K, drive, measured, start, end, time):
    def one(M, D, K):
        system = drive.state_space(M, D, K, measured, time)
        Ad, B0, B1 = hold_matrices(system.A, system.B, 1.0, "linear")
        feed = jnp.concatenate([system.D, jnp.zeros_like(system.D)], axis=1)
        both = jnp.concatenate([start, end], axis=1)
        return respond(Ad, jnp.concatenate([B0, B1], axis=1), system.C, feed, both)

    return jax.vmap(one)(M, D, K)


_MAKERS = {"force": _force_columns, "input": _input_columns, "output": _output_columns, "matrix": _matrix_columns}
