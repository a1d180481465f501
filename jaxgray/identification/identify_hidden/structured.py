"""Masses, dampers and springs that are connected as a person says."""

from dataclasses import replace

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ...numerics.outcomes import RESULTS, ComputationError
from ..hidden import Connections, Family, HiddenEvidence, alike, matched
from ..initialization.start import Start, total_deviation
from ..refinement.normal_equations import join
from ..refinement.refine import Refinement, StructurePrice
from ..result import Identification
from .canonical import canonical_fit
from .elements import elements_of, undetermined_entries
from .structured_starts import MOST_ALTERNATIVES, family_of, known_elements, structured_starts
from .task import Task, assessed, collocated, cost_in_colour, in_windows, model_of, refined_from, start_of

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
    known, normalised = known_elements(task, connections)
    if normalised:
        notes += (
            "Base excitation determines M⁻¹D and M⁻¹K only: the model is normalised to "
            f"mass[{connections.names[0]}] = 1; give a mass with fix to set the scale.",
        )
    form, family, units, given = family_of(task, connections, known)
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
    starts, outcome = structured_starts(task, family, found, free, connections, units, given)
    start, (best, tau, rows) = starts[0], found[0]
    refinement, others = None, []
    if task.request.refine:
        task.progress.stage("refining")
        enough = EXPLAINED * np.asarray(best.deviation)
        task, refinements = _all_refined(task, family, starts, form, held, enough)
        if task.request.noise == "output-error" and task.records is not task.whole:
            noisy = replace(task, request=replace(task.request, noise="innovations"))
            likelier = _likelier_with_force_noise(task, noisy, start, refinements[0], form, held)
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
        others = starts[1:]
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
