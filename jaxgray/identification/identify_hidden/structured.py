"""Masses, dampers and springs that are connected as a person says."""

import contextlib
from dataclasses import replace

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ...mechanics.drives import Force
from ...mechanics.model import MechanicalModel
from ...numerics.outcomes import RESULTS, ComputationError
from ..hidden import (
    Connections,
    Family,
    HiddenEvidence,
    HigherOrder,
    alike,
    determinacy,
    fixed_elements,
    matched,
    realized_response,
)
from ..initialization.start import Start, total_deviation
from ..refinement.normal_equations import join
from ..refinement.refine import Refinement, StructurePrice
from ..result import Identification
from ..setup.structure import Structure
from .canonical import canonical_fit
from .elements import elements_of, undetermined_entries
from .start import high_passed_realizations
from .task import Task, assessed, collocated, cost_in_colour, in_windows, merit, model_of, refined_from, start_of

MOST_ALTERNATIVES = 4
"""Equally good sets of parameters that are refined first, and that are kept."""

MOST_CONSISTENT, MOST_TRIED, FEW_STARTS = 2, 8, 16
"""Where the structure does not have the transfer function of the best realisation: models that are kept of those that
others have, realisations that are tried of every filter, and random starts for each."""

POOR_MATCH = 1e-4
"""Mean squared relative error of a structure's transfer function from which the slowest poles are not trusted."""

DRIFTS = "Slow drift outweighs the vibration: refined with noise at the forces too (noise='innovations')."
"""What is said where the noise was not what was asked for."""

EXPLAINED = 1.02
"""Mean square that a refinement leaves, by that of the best realisation, up to which nothing better is looked for."""

CLEARLY = 100.0
"""Fall of −2 ln L from which another noise is clearly likelier."""

AS_LIKELY = 6.0
"""Rise of −2 ln L up to which another set of parameters counts as equally good."""


def structured(task: Task, found, connections: Connections, notes: tuple[str, ...]) -> Identification:
    """Masses, dampers and springs of a structure."""
    drive = task.drive
    known, normalised = _known(task, connections)
    if normalised:
        notes += (
            "Base excitation determines M⁻¹D and M⁻¹K only: the model is normalised to "
            f"mass[{connections.names[0]}] = 1; give a mass with fix to set the scale.",
        )
    form, family, units, given = _family(task, connections, known)
    held = np.isfinite(given)

    task.progress.stage("structure")
    free = None
    if collocated(drive, task.outputs) and task.request.refine:
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
        if others.errors[0] < POOR_MATCH:
            ends = others
        else:
            ends = max((ends, others), key=lambda one: _matched_merit(task, family, one.parameters[0], best, tau, rows))
    theta = np.where(held, np.nan_to_num(given), ends.parameters)
    consistent, noisy = [], None
    if ends.errors[0] > POOR_MATCH:
        matches = _matches(task, family, found, given)
        consistent = _consistent(family, matches)
        noisy = max(matches, key=lambda match: merit(task, _begun(task, family, match)), default=None)
        theta = np.concatenate([*(match[1][None] for match in consistent), theta])
    outcome = determinacy(family, theta[0], connections.elements, units=units, held=held)
    candidates = theta[len(consistent) :][: MOST_ALTERNATIVES if outcome.complete else 1]
    starts = [start_of(task, family.matrices(x), best, tau, rows, "subspace") for x in candidates]
    if noisy is not None and not consistent:
        # Noise bends every realisation, and the structure has the transfer function of none.
        consistent = [noisy]
    starts = [_begun(task, family, match) for match in consistent] + starts
    order = np.argsort([-s.score for s in starts], kind="stable")
    start = starts[order[0]]
    refinement, others = None, []
    if task.request.refine:
        task.progress.stage("refining")
        enough = EXPLAINED * np.asarray(best.deviation)
        task, refinements = _all_refined(task, family, [starts[k] for k in order], form, held, enough)
        if task.request.noise == "output-error" and task.records is not task.whole:
            noisy = replace(task, request=replace(task.request, noise="innovations"))
            likelier = _likelier_with_force_noise(task, noisy, starts[order[0]], refinements[0], form, held)
            if likelier is not None:
                task, refinements, free, notes = noisy, [likelier], None, (*notes, DRIFTS)
        if outcome.complete:
            # From equally good starts not every refinement arrives; what equals the best one is known from it alone.
            exchanged = _exchanged(task, family, _elements(refinements[0]), given, (best, tau, rows))
            refinements += _refined(task, exchanged, form, held)[0]
            refinements = _no_two_alike(refinements, family)[:MOST_ALTERNATIVES]
        refinement, others = refinements[0], refinements[1:]
        if free is not None and free[2] is not None:
            saved = int((~free[4]).sum() - (~held).sum())
            price = StructurePrice(saved, refinement.cost - free[2].cost)
            refinement = eqx.tree_at(lambda r: r.price, refinement, price, is_leaf=lambda x: x is None)
    else:
        others = [starts[k] for k in order[1:]]
    model = model_of(task, refinement, start, known)
    alternatives = tuple(model_of(task, other, other, known) for other in others)
    undetermined = undetermined_entries(connections, outcome, held)
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
    result = assessed(task, model, start, refinement, form, held, notes, evidence)
    elements = elements_of(result, connections, outcome, held)
    return replace(result, hidden=replace(evidence, elements=elements))


def _known(task: Task, connections: Connections) -> tuple[dict[tuple[str, int], float], bool]:
    """Elements that are given, in the record's units; and whether the first mass is set to 1 among them: where none is
    given, an excited base leaves the scale of masses open."""
    known = fixed_elements(task.request.fix, connections)
    normalised = not isinstance(task.drive, Force) and not any(owner == "mass" for owner, _ in known)
    return (known | {("mass", 0): 1.0} if normalised else known), normalised


def _family(task: Task, connections: Connections, known):
    """A structure in the units of the task: its assemblies, its transfer functions, the units of its elements, and the
    elements that are given, NaN for the others."""
    form = connections.structure.scaled(np.asarray(task.scaling.coordinates))
    units = _element_units(task, form)
    position = {"mass": 0, "damping": task.dofs, "stiffness": task.dofs + len(connections.dampers)}
    given = np.full(len(units), np.nan)
    for (owner, k), value in known.items():
        given[position[owner] + k] = value * units[position[owner] + k]
    return form, Family.of(form, task.setting), units, given


def consistent_models(task: Task, found, connections: Connections) -> list[MechanicalModel]:
    """Models of the structure whose transfer function a realisation of the record has, the best first, not refined."""
    known, _ = _known(task, connections)
    _, family, _, given = _family(task, connections, known)
    starts = [_begun(task, family, match) for match in _consistent(family, _matches(task, family, found, given))]
    return [model_of(task, one, one, known) for one in starts]


def _matches(task: Task, family: Family, found, given) -> list[tuple[float, np.ndarray, tuple]]:
    """What the structure makes of every realisation, the best match first: its error, parameters, the realisation."""
    matches = []
    for model, tau, rows in (one for some in (found, *high_passed_realizations(task)) for one in some[:MOST_TRIED]):
        with contextlib.suppress(ComputationError, np.linalg.LinAlgError):
            ends = matched(family, *_target(task, model, None), given, starts=FEW_STARTS)
            theta = np.where(np.isfinite(given), np.nan_to_num(given), ends.parameters[0])
            matches.append((float(ends.errors[0]), theta, (model, tau, rows)))
    return sorted(matches, key=lambda match: match[0])


def _begun(task: Task, family: Family, match) -> Start:
    return start_of(task, family.matrices(match[1]), *match[2], "subspace")


def _consistent(family: Family, matches) -> list:
    """Those whose transfer function the structure has: what it lacks bends every realisation differently, hardly any of
    them into another one that it can have."""
    kept: list[tuple] = []
    for match in matches:
        good = match[0] < POOR_MATCH and len(kept) < MOST_CONSISTENT
        if good and not any(alike(match[1], other[1], family) for other in kept):
            kept.append(match)
    return kept


def _matched_merit(task: Task, family: Family, theta, model: HigherOrder, tau: float, rows: int) -> float:
    with np.errstate(all="ignore"):
        return merit(task, start_of(task, family.matrices(theta), model, tau, rows, "subspace"))


def _target(task: Task, best: HigherOrder, free):
    """The transfer function to match, in the units of the task, and the sizes of its poles."""
    if free is None or free[2] is None:
        values = np.abs(np.linalg.eigvals(best.A))
        return lambda s: realized_response(best.A, best.B, best.Cy, best.Dy, s), values
    own, refinement = free[0].setting, free[2]
    M, D, K = (np.asarray(X) for X in (refinement.mass, refinement.damping, refinement.stiffness))
    system = own.drive.state_space(M, D, K, own.measured, 1.0)
    A, B, C, Dy = (np.asarray(X) for X in (system.A, system.B, system.C, system.D))
    return lambda s: realized_response(A, B, C, Dy, s), np.abs(np.linalg.eigvals(A))


def _all_refined(task: Task, family: Family, starts: list[Start], form, held, enough) -> tuple[Task, list[Refinement]]:
    """Refinements from several starts, no two alike; from the first alone where it leaves no more than `enough`."""
    task = in_windows(task, starts[0])
    ends, failure = _refined(task, starts[:1], form, held)
    if not (ends and _explains(task, ends[0], enough)):
        further, other = _refined(task, starts[1:], form, held)
        ends, failure = ends + further, other or failure
    if not ends:
        raise failure
    return task, _no_two_alike(ends, family)


def _likelier_with_force_noise(task, noisy, start, end: Refinement, form, held) -> Refinement | None:
    """Where the residual has a colour: the refinement with noise at the forces, if it is likelier than the one without
    under that colour. Slow drift that passes for white noise leads a refinement away."""
    coloured = cost_in_colour(task, end)
    if not coloured < end.cost - CLEARLY:
        return None
    try:
        other = refined_from(noisy, start, form, held)
    except ComputationError:
        return None
    return other if other.cost < coloured - CLEARLY else None


def _explains(task: Task, end: Refinement, enough: Float[np.ndarray, " outputs"]) -> bool:
    if end.result != RESULTS.successful or task.records is not task.whole:
        return False
    left = total_deviation((end.mass, end.damping, end.stiffness), task.setting, task.complete)
    return bool(np.all(left <= enough))


def _refined(task: Task, starts: list[Start], form, held) -> tuple[list[Refinement], ComputationError | None]:
    """Refinements that came to an end, and why the last other one did not."""
    ends, failure = [], None
    for start in starts:
        try:
            ends.append(refined_from(task, start, form, held))
        except ComputationError as error:
            failure = error
    return ends, failure


def _exchanged(task: Task, family: Family, theta, given, start) -> list[Start]:
    """Every other set of parameters with the same transfer function."""
    M, D, K = family.matrices(theta)
    eye, none = np.eye(len(M)), np.zeros_like(M)
    rates = np.abs(scipy.linalg.eigvals(np.block([[none, eye], [-K, -D]]), scipy.linalg.block_diag(eye, M)))
    rates = rates[np.isfinite(rates)]
    ends = matched(family, lambda s: family.response(theta[None], s)[0][0], rates, given)
    sets = np.where(np.isfinite(given), np.nan_to_num(given), ends.parameters)
    return [start_of(task, family.matrices(x), *start, "subspace") for x in sets if not alike(x, theta, family)]


def _no_two_alike(ends: list[Refinement], family: Family) -> list[Refinement]:
    """Those as likely as the best, the best first."""
    ends = sorted(ends, key=lambda end: end.cost)
    kept: list[Refinement] = []
    for end in ends:
        same = (alike(_elements(end), _elements(one), family) for one in kept)
        if end.cost <= ends[0].cost + AS_LIKELY and not any(same):
            kept.append(end)
    return kept


def _elements(end: Refinement) -> Float[np.ndarray, " parameters"]:
    return join([np.asarray(block) for block in end.blocks])


def _element_units(task: Task, form: Structure) -> Float[np.ndarray, " parameters"]:
    """Scaled parameters for one unit of every mass, damper and spring."""
    T = float(task.scaling.sampling_time)
    masses = np.asarray(task.scaling.coordinates) ** 2
    return np.concatenate([masses / T**2, form.damping.units / T, form.stiffness.units])
