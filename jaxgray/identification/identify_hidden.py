"""From records to a model with coordinates that no output measures."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from ..mechanics.drives import AbstractDrive, Force
from ..mechanics.model import MechanicalModel, hidden_names
from ..mechanics.statespace import StateSpace, sampled
from ..numerics.linear_algebra import triangle
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.progress import AbstractProgress
from ..records import Record
from .hidden import (
    MEMORIES,
    Connections,
    Determinacy,
    Element,
    Family,
    HiddenEvidence,
    HigherOrder,
    block_row_choices,
    canonical_count,
    canonical_gauge,
    canonical_structure,
    closed_form,
    determinacy,
    fixed_elements,
    high_passed,
    in_units,
    is_connections,
    matched,
    physical_canonical,
    realizations,
    realized_response,
)
from .initialization.guard import lost
from .initialization.rigid import DRIFT, TURNED, phases, rigid_modes, windows
from .initialization.start import Start, filled, total_deviation
from .refinement.normal_equations import join
from .refinement.refine import Refinement, StructurePrice, refine, start_kept
from .result import Identification, assess
from .setup.options import drive_of, pick
from .setup.prediction import Batch, Setting, best_run
from .setup.preparation import Signals, prepare, scaling_of
from .setup.structure import Structure
from .setup.units import Scaling
from .subspace.grid import default_time_constants, score
from .subspace.projection import WEIGHTS
from .subspace.realization import MAPS
from .validation.reach import check_reach

MOST_REALIZATIONS = 4
"""Realisations, the best first, that are turned into starting models."""

MOST_ALTERNATIVES = 4
"""Equally good sets of parameters that are refined."""

POOR_MATCH = 1e-4
"""Mean squared relative error of a structure's transfer function from which the slowest poles are not trusted."""

ZERO = 1e-9
"""Share of the largest element of its kind below which one counts as zero."""

AS_LIKELY = 6.0
"""Rise of −2 ln L up to which another set of parameters counts as equally good."""


@dataclass(frozen=True)
class HiddenRequest:
    """What is asked for: `structure`: connections, None for the canonical form; `fix`; `noise`; how the input enters;
    what the start is looked for with; whether to `refine`; `names` of the hidden coordinates."""

    structure: object
    fix: object
    noise: str
    excitation: str
    input_map: object
    relative: bool
    time_constants: object
    block_rows: object
    weight: object
    map: object
    refine: bool
    names: tuple[str, ...] = ()

    def named(self, hidden, outputs: tuple[str, ...]) -> "HiddenRequest":
        """The request with its hidden coordinates, its structure as text.

        **Arguments:** `hidden`: how many, or their names; `outputs`: names of the outputs.

        **Raises:** `ValueError` where these, or the structure, are not understood.
        """
        given = self.structure
        text = given if given is None or isinstance(given, str) else ", ".join(given)
        names = hidden_names(hidden)
        if text and not is_connections(text, outputs + names):
            raise ValueError(
                f"structure={given!r} says nothing of hidden coordinates; say how they are connected, such as "
                f"'{outputs[0]}-{names[0] if names else 'ground'}' (masses are diagonal then)."
            )
        return replace(self, names=names, structure=text or None)


def wants_hidden(hidden, structure, outputs: tuple[str, ...]) -> bool:
    """Whether a model with hidden coordinates, or with named connections, is asked for; `outputs`: their names.

    **Raises:** `ValueError` where `hidden` is not understood.
    """
    if hidden == "auto":
        return True
    if isinstance(hidden, str):
        raise ValueError(f"hidden={hidden!r} is not understood; give a number, 'auto', or a list of names.")
    return bool(hidden_names(hidden)) or is_connections(structure, outputs)


@dataclass(frozen=True)
class _Task:
    """Records (`whole`, or pieces of them) and everything that stays fixed while models are looked for; scaled."""

    whole: list[Record]
    records: list[Record]
    held_out: list[Record]
    signals: list[Signals]
    complete: list[Signals]
    drive: AbstractDrive
    scaling: Scaling
    request: HiddenRequest
    progress: AbstractProgress

    @property
    def outputs(self) -> int:
        return self.records[0].outputs

    @property
    def dofs(self) -> int:
        return self.outputs + len(self.request.names)

    def with_units(self, size: float) -> "_Task":
        """The same where hidden coordinates are counted in other units."""
        own = np.asarray(self.scaling.coordinates)[: self.outputs]
        coordinates = np.concatenate([own, np.full(len(self.request.names), size)])
        return replace(self, scaling=eqx.tree_at(lambda s: s.coordinates, self.scaling, coordinates))

    @property
    def setting(self) -> Setting:
        drive = jax.device_get(self.drive).scaled(
            np.asarray(self.scaling.coordinates), self.scaling.inputs, self.scaling.sampling_time
        )
        return Setting(drive, self.records[0].measured, self.records[0].hold, len(self.request.names))


def identify_hidden(
    records: list[Record],
    held_out: list[Record],
    request: HiddenRequest,
    notes: list[str],
    progress: AbstractProgress,
) -> Identification:
    """A model with hidden coordinates: subspace realisation of higher order, closed form, then prediction error.

    **Arguments:** `records`, `held_out`: checked; `request`; `notes`: warnings so far; `progress`.

    **Returns:** an `Identification` with `hidden` evidence.

    **Raises:** `ValueError` where the request does not fit the record; `ComputationError` where no model is found.
    """
    first = records[0]
    drive = drive_of(first, request.excitation, request.input_map, request.relative, request.names)
    connections = None
    if request.structure is not None:
        connections = Connections(request.structure, first.output_names + request.names)
    elif not _collocated(drive, first.outputs):
        raise ValueError(
            f"hidden={len(request.names)} without a structure needs a force on every measured coordinate and on no "
            f"other; say how the coordinates are connected, such as structure='{_example(first, request.names)}'."
        )
    progress.stage("preparing")
    scaling = scaling_of(records)
    signals = [prepare(r, scaling) for r in records]
    complete = filled(records, scaling, None) if any(r.has_missing for r in records) else signals
    check_reach(complete, first.input_names, first.output_names)
    middle = float(np.exp(np.mean(np.log(np.asarray(scaling.coordinates)))))
    task = _Task(records, records, held_out, signals, complete, drive, scaling, request, progress).with_units(middle)
    found = _realizations(task)
    if complete is not signals:
        runs = [_run(found[0][0], task, s) for s in complete]
        task = replace(task, complete=filled(records, scaling, runs))
        found = _realizations(task)
    if connections is None:
        return _canonical(task, found, tuple(notes))
    return _structured(task, found, connections, tuple(notes))


def _collocated(drive: AbstractDrive, outputs: int) -> bool:
    """Whether forces act on every measured coordinate and on no hidden one."""
    if not isinstance(drive, Force):
        return False
    E = np.asarray(drive.input_map)
    return bool(np.linalg.matrix_rank(E[:outputs]) == outputs and not np.any(E[outputs:]))


def _example(record: Record, names: tuple[str, ...]) -> str:
    every = (*record.output_names, *names)
    return ", ".join(f"{a}-{b}" for a, b in zip(every, every[1:])) or f"{every[0]}-ground"


def _realizations(task: _Task) -> list[tuple[HigherOrder, float, int]]:
    request, record = task.request, max(task.records, key=lambda r: r.samples)
    task.progress.stage("subspace start")
    order = 2 * task.dofs
    most = max(3, (record.samples // 3) // (2 * (record.inputs + record.outputs) + 2))
    rows = block_row_choices(record.outputs, order, most)
    if request.block_rows is not None:
        rows = tuple(int(i) for i in np.unique(np.atleast_1d(request.block_rows)))
    if (min(rows) - 1) * record.outputs < order:
        raise ValueError(
            f"block_rows={min(rows)} are too few for {order} states and {record.outputs} outputs; give at least "
            f"{-(-order // record.outputs) + 1}, or a longer record."
        )
    taus = default_time_constants(record) if request.time_constants is None else np.atleast_1d(request.time_constants)

    def found(signals: list[Signals]):
        return realizations(
            signals,
            task.setting.drive,
            record.measured,
            record.hold,
            task.scaling.sampling_time,
            order,
            time_constants=np.asarray(taus, float),
            block_rows=rows,
            weight=pick("weight", request.weight, WEIGHTS),
            map=pick("map", request.map, MAPS),
        )

    models = found(task.complete)
    if not np.any(models[0][0].deviation > DRIFT):
        return models
    families = [models]
    for memory in MEMORIES:
        parts = [high_passed(s, memory) for s in task.complete]
        # Several records in the units of the longest.
        _, inputs, outputs = max(parts, key=lambda part: part[0].samples)
        signals = [
            eqx.tree_at(lambda s: (s.u, s.y), s, (s.u * own_u / inputs, s.y * own_y / outputs))
            for s, own_u, own_y in parts
        ]
        try:
            families.append([(in_units(m, inputs, outputs), tau, i) for m, tau, i in found(signals)])
        except ComputationError:
            continue
    # By turns from every family: their free runs are no measure of one another.
    return [family[k] for k in range(MOST_REALIZATIONS) for family in families if k < len(family)]


def _run(model: HigherOrder, task: _Task, signals: Signals) -> np.ndarray:
    """Free run of a realisation, scaled."""
    system = sampled(StateSpace(model.A, model.B, model.Cy, model.Dy), 1.0, task.records[0].hold)
    return np.asarray(best_run(system, signals)[0])


def _start(task: _Task, matrices, model: HigherOrder, tau: float, rows: int, method: str) -> Start:
    deviation = total_deviation(matrices, task.setting, task.complete)
    return Start(matrices, deviation, method, tau, rows, model.singular_values, None)


def _canonical(task: _Task, found, notes: tuple[str, ...]) -> Identification:
    """The canonical form of the record's inputs and outputs."""
    task, start, refinement, form, held = canonical_fit(task, found)
    model = _model(task, refinement, start, {})
    p, n = task.outputs, len(task.request.names)
    gauge = dict(zip(("mass", "damping", "stiffness"), canonical_gauge(p, n)))
    none = {name: np.zeros_like(X) for name, X in gauge.items()}
    count = canonical_count(p, n)
    evidence = HiddenEvidence(task.request.names, True, gauge, none, (), count, count, (), ())
    return _assessed(task, model, start, refinement, form, held, notes, evidence)


def canonical_fit(
    task: _Task, found
) -> tuple[_Task, Start, Refinement | None, Structure, Bool[np.ndarray, " entries"]]:
    """Closed form and refinement; the task with the units of the hidden coordinates that were chosen.

    **Raises:** `ComputationError` where no realisation has a canonical form.
    """
    p, n = task.outputs, len(task.request.names)
    if task.request.fix:
        raise ValueError(
            f"fix={task.request.fix!r} needs a structure: without one, entries belong to a representative; give "
            f"structure='{_example(task.records[0], task.request.names)}' or the like."
        )
    starts, failure = [], None
    for model, tau, rows in found[: 2 * MOST_REALIZATIONS]:
        try:
            starts.append(_canonical_start(task, model, tau, rows))
        except (ComputationError, np.linalg.LinAlgError) as error:
            failure = error
    if not starts:
        detail = getattr(failure, "detail", None) or str(failure)
        raise ComputationError(RESULTS.unstable_start, stage="closed form", detail=detail)
    task, start = max(starts, key=lambda pair: _merit(*pair))
    form = canonical_structure(*(np.asarray(X) for X in start.matrices), n)
    held = np.zeros(canonical_count(p, n), bool)
    if not task.request.refine:
        return task, start, None, form, held
    task = _in_windows(task, start)
    task.progress.stage("refining")
    refinement = _refined(task, start, form, held)
    return task, start, refinement, form, held


def _canonical_start(task: _Task, model: HigherOrder, tau: float, rows: int) -> tuple[_Task, Start]:
    p = task.outputs
    E = np.asarray(task.setting.drive.input_map)[:p]
    form = closed_form(model.A, model.B @ np.linalg.pinv(E), model.C)
    mean = np.trace(form.mass) / p
    if not mean > 0:
        raise ComputationError(RESULTS.semidefinite_solver, stage="closed form", detail="the mass is negative")
    # A unit mass of the record's units, counted so that it is as large as the measured ones.
    size = np.sqrt(mean)
    M, D, K = physical_canonical(form)
    units = np.concatenate([np.ones(p), np.full(form.hidden, size)])
    matrices = tuple(X * units[:, None] * units[None, :] for X in (M, D, K))
    task = task.with_units(float(task.scaling.sampling_time) * size)
    return task, _start(task, matrices, model, tau, rows, "subspace")


def _merit(task: _Task, start: Start) -> float:
    """Likelihood of a start's free run, over pieces of the record where it drifts."""
    pieces = _in_windows(task, start)
    if pieces.records is task.whole:
        return start.score
    return float(score(total_deviation(start.matrices, pieces.setting, pieces.signals)))


def _in_windows(task: _Task, start: Start) -> _Task:
    """The task on pieces of the records where a body free to move drifts in the free run over the whole."""
    longest = max(r.samples for r in task.records)
    if task.records is not task.whole or not rigid_modes(start, longest) or not np.max(start.deviation) > DRIFT:
        return task
    pieces = windows(task.records)
    return replace(task, records=pieces, signals=[prepare(r, task.scaling) for r in pieces])


def _refined(task: _Task, start: Start, form: Structure, held) -> Refinement:
    """Refinement by prediction error, kept only where it is no worse on held-out records."""
    batch, setting = Batch.of(task.signals), task.setting
    longest = max(r.samples for r in task.records)
    offset = bool(phases(start.matrices, longest)[0] > TURNED)
    options = {"structure": form, "offset": offset}
    innovations = task.request.noise == "innovations"

    def refined(near: bool) -> Refinement:
        return refine(
            start.matrices,
            batch,
            setting,
            fixed=held if np.any(held) else None,
            innovations=innovations,
            deviation=np.asarray(start.deviation),
            near=near,
            **options,
        )

    refinement = None
    if start.serves and not innovations:
        # Next to the optimum the steps over the cone alone are quicker, and exact.
        try:
            refinement = refined(near=True)
        except ComputationError:
            refinement = None
    if refinement is None or refinement.result != RESULTS.successful:
        other = refined(near=False)
        refinement = other if refinement is None or other.cost < refinement.cost else refinement
    end = refinement.mass, refinement.damping, refinement.stiffness
    held_out = [prepare(r, task.scaling) for r in task.held_out]
    if task.request.noise == "output-error" and lost(end, start.matrices, setting, held_out):
        return start_kept(start.matrices, batch, setting, prior=None, **options)
    return refinement


def _structured(task: _Task, found, connections: Connections, notes: tuple[str, ...]) -> Identification:
    """Masses, dampers and springs of a structure."""
    drive = task.drive
    known = fixed_elements(task.request.fix, connections)
    if not isinstance(drive, Force) and not any(owner == "mass" for owner, _ in known):
        known["mass", 0] = 1.0
        notes += (
            "Base excitation determines M⁻¹D and M⁻¹K only: the model is normalised to "
            f"mass[{connections.names[0]}] = 1; give a mass with fix to set the scale.",
        )
    form = connections.structure.scaled(np.asarray(task.scaling.coordinates))
    family = Family.of(form, task.setting)
    units = _element_units(task, form)
    position = {"mass": 0, "damping": task.dofs, "stiffness": task.dofs + len(connections.dampers)}
    held = np.zeros(len(units), bool)
    given = np.full(len(units), np.nan)
    for (owner, k), value in known.items():
        held[position[owner] + k], given[position[owner] + k] = True, value * units[position[owner] + k]

    task.progress.stage("structure")
    free = None
    if _collocated(drive, task.outputs) and task.request.refine:
        try:
            free = canonical_fit(replace(task, request=replace(task.request, fix=None)), found)
        except ComputationError:
            free = None
        if free is not None:
            task = replace(task, records=free[0].records, signals=free[0].signals)
    best, tau, rows = found[0]
    target, rates = _target(task, best, free)
    ends = matched(family, target, rates, given)
    loose = task.dofs - np.linalg.matrix_rank(family.matrices(np.ones(len(units)))[2])
    if loose and ends.errors[0] > POOR_MATCH:
        # What drift made of the slowest poles says nothing of a body that no spring holds.
        others = matched(family, target, np.sort(rates)[2 * loose :], given)
        ends = max((ends, others), key=lambda found: _matched_merit(task, family, found.parameters[0], best, tau, rows))
    theta = np.where(held, np.nan_to_num(given), ends.parameters)
    outcome = determinacy(family, theta[0], connections.elements, units=units, held=held)
    candidates = theta[: MOST_ALTERNATIVES if outcome.complete else 1]
    starts = [_start(task, family.matrices(x), best, tau, rows, "subspace") for x in candidates]
    order = np.argsort([-s.score for s in starts], kind="stable")
    start = starts[order[0]]
    refinement, others = None, []
    if task.request.refine:
        task.progress.stage("refining")
        task, refinements = _all_refined(task, [starts[k] for k in order], form, held)
        refinement, others = refinements[0], refinements[1:]
        if free is not None and free[2] is not None:
            saved = int((~free[4]).sum() - (~held).sum())
            price = StructurePrice(saved, refinement.cost - free[2].cost)
            refinement = eqx.tree_at(lambda r: r.price, refinement, price, is_leaf=lambda x: x is None)
    else:
        others = [starts[k] for k in order[1:]]
    model = _model(task, refinement, start, known)
    alternatives = tuple(_model(task, other, other, known) for other in others)
    undetermined = _undetermined(connections, outcome, held)
    none = {name: np.zeros_like(X) for name, X in undetermined.items()}
    evidence = HiddenEvidence(
        task.request.names,
        False,
        none,
        undetermined,
        outcome.combinations,
        outcome.rank,
        outcome.parameters,
        (),
        alternatives,
    )
    result = _assessed(task, model, start, refinement, form, held, notes, evidence)
    elements = _elements(result, connections, outcome, held)
    return replace(result, hidden=replace(evidence, elements=elements))


def _matched_merit(task: _Task, family: Family, theta, model: HigherOrder, tau: float, rows: int) -> float:
    with np.errstate(all="ignore"):
        return _merit(task, _start(task, family.matrices(theta), model, tau, rows, "subspace"))


def _target(task: _Task, best: HigherOrder, free):
    """The transfer function to match, in the units of the task, and the sizes of its poles."""
    if free is None or free[2] is None:
        values = np.abs(np.linalg.eigvals(best.A))
        return lambda s: realized_response(best.A, best.B, best.Cy, best.Dy, s), values
    own, refinement = free[0].setting, free[2]
    M, D, K = (np.asarray(X) for X in (refinement.mass, refinement.damping, refinement.stiffness))
    system = own.drive.state_space(M, D, K, own.measured, 1.0)
    A, B, C, Dy = (np.asarray(X) for X in (system.A, system.B, system.C, system.D))
    return lambda s: realized_response(A, B, C, Dy, s), np.abs(np.linalg.eigvals(A))


def _all_refined(task: _Task, starts: list[Start], form, held) -> tuple[_Task, list[Refinement]]:
    """Refinements from equally good starts; of the ends, those as likely as the best, no two alike."""
    task = _in_windows(task, starts[0])
    ends, failure = [], None
    for start in starts:
        try:
            ends.append(_refined(task, start, form, held))
        except ComputationError as error:
            failure = error
    if not ends:
        raise failure
    least = min(end.cost for end in ends)
    kept: list[Refinement] = []
    for end in sorted(ends, key=lambda end: end.cost):
        if end.cost > least + AS_LIKELY:
            continue
        z = join([np.asarray(block) for block in end.blocks])
        if not any(np.allclose(z, join([np.asarray(b) for b in other.blocks]), rtol=0.01) for other in kept):
            kept.append(end)
    return task, kept


def _element_units(task: _Task, form: Structure) -> Float[np.ndarray, " parameters"]:
    """Scaled parameters for one unit of every mass, damper and spring."""
    T = float(task.scaling.sampling_time)
    masses = np.asarray(task.scaling.coordinates) ** 2
    return np.concatenate([masses / T**2, form.damping.units / T, form.stiffness.units])


def _model(task: _Task, refinement, start, known) -> MechanicalModel:
    if isinstance(refinement, Refinement):
        scaled = refinement.mass, refinement.damping, refinement.stiffness
    else:
        scaled = start.matrices
    matrices = [np.array(X) for X in task.scaling.matrices_out(*(np.asarray(X) for X in jax.device_get(scaled)))]
    first = task.records[0]
    for (owner, k), value in known.items():
        if owner == "mass":
            matrices[0][k, k] = value
    if task.request.structure is None:
        p = task.outputs
        for matrix, own in zip(matrices, canonical_gauge(p, len(task.request.names))):
            matrix[own] = 0.0
        matrices[0][range(p, task.dofs), range(p, task.dofs)] = 1.0
    return MechanicalModel(
        *matrices,
        drive=task.drive,
        measured=first.measured,
        input_names=first.input_names,
        output_names=first.output_names,
        input_units=first.input_units,
        output_units=first.output_units,
        hidden=task.request.names,
    )


def _assessed(task: _Task, model, start, refinement, form, held, notes, evidence) -> Identification:
    extra = ()
    if evidence.rank < evidence.parameters or evidence.alternatives:
        extra = tuple(evidence.sentences())
    extra += tuple(
        f"{name} ends at zero, the edge of what is physical; its error bar is one-sided."
        for name in _at_zero(model, task)
    )
    result = assess(
        model,
        task.records,
        task.held_out,
        task.setting,
        task.scaling,
        task.signals,
        Batch.of(task.signals),
        form,
        held,
        start,
        refinement,
        notes + extra,
        evidence,
    )
    return result if task.records is task.whole else result.judged_on(task.whole)


def _at_zero(model: MechanicalModel, task: _Task) -> list[str]:
    """Dampers and springs of a structure that ended at zero."""
    if task.request.structure is None:
        return []
    connections = Connections(task.request.structure, model.coordinates)
    rows, columns = triangle(model.dofs)
    entries = np.concatenate([np.asarray(X)[rows, columns] for X in (model.mass, model.damping, model.stiffness)])
    values = np.linalg.pinv(_entries_by_elements(connections)) @ entries
    found = []
    for owner in ("damping", "stiffness"):
        own = [k for k, name in enumerate(connections.elements) if name.startswith(owner)]
        found += [connections.elements[k] for k in own if values[k] <= ZERO * np.max(values[own])]
    return found


def _entries_by_elements(connections: Connections) -> Float[np.ndarray, "entries parameters"]:
    """Derivative of the stacked triangles of M, D, K by masses, dampers and springs."""
    dofs = len(connections.names)
    structure = connections.structure
    rows, columns = triangle(dofs)
    result = []
    for unit in np.eye(len(connections.elements)):
        three = structure.matrices([np.array([[v]]) for v in unit], dofs)
        result.append(np.concatenate([np.asarray(X)[rows, columns] for X in three]))
    return np.stack(result, axis=1)


def _undetermined(connections: Connections, outcome: Determinacy, held) -> dict[str, Bool[np.ndarray, "dofs dofs"]]:
    """Entries of M, D, K that depend on what is open, but for combinations that are determined."""
    L = _entries_by_elements(connections)[:, ~held]
    space = outcome.space
    left = L - (L @ space.T) @ space
    size = np.linalg.norm(L, axis=1)
    opened = np.linalg.norm(left, axis=1) > 1e-4 * np.where(size > 0, size, 1.0)
    dofs = len(connections.names)
    rows, columns = triangle(dofs)
    found = {}
    for name, values in zip(("mass", "damping", "stiffness"), np.split(opened, 3)):
        found[name] = np.zeros((dofs, dofs), bool)
        found[name][rows, columns] = found[name][columns, rows] = values
    return found


def _elements(result: Identification, connections: Connections, outcome: Determinacy, held) -> tuple[Element, ...]:
    """Values and errors of masses, dampers and springs, from those of the matrices."""
    L = _entries_by_elements(connections)
    back = np.linalg.pinv(L)
    rows, columns = triangle(len(connections.names))
    entries = np.concatenate([X[rows, columns] for X in (result.mass, result.damping, result.stiffness)])
    values = back @ entries
    errors = None
    if result.uncertainty is not None:
        errors = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", back, result.covariance, back), 0.0))
    found = []
    for k, name in enumerate(connections.elements):
        determined = bool(outcome.determined[k])
        error = None if errors is None or not determined else float(errors[k])
        found.append(Element(name, float(values[k]) if determined else None, error, bool(held[k])))
    return tuple(found)
