"""Where the refinement of a structure with hidden coordinates begins: what the structure makes of the realisations."""

import contextlib

import numpy as np
from jaxtyping import Float

from ...mechanics.model import MechanicalModel
from ...mechanics.systems.drives import Force
from ...numerics.outcomes import ComputationError
from ..hidden import (
    Connections,
    Determinacy,
    Family,
    HigherOrder,
    alike,
    determinacy,
    fixed_elements,
    matched,
    realized_response,
)
from ..initialization.start import Start
from ..setup.structure import Structure
from .start import high_passed_realizations
from .task import Task, merit, model_of, start_of

MOST_ALTERNATIVES = 4
"""Equally good sets of parameters that are refined first, and that are kept."""

MOST_CONSISTENT, MOST_TRIED, FEW_STARTS = 2, 8, 16
"""Where the structure does not have the transfer function of the best realisation: models that are kept of those that
others have, realisations that are tried of every filter, and random starts for each."""

POOR_MATCH = 1e-4
"""Mean squared relative error of a structure's transfer function from which the slowest poles are not trusted."""


def structured_starts(
    task: Task, family: Family, found, free, connections: Connections, units, given
) -> tuple[list[Start], Determinacy]:
    """Models of the structure to begin with, the best free run first, and what the record determines of it.

    **Arguments:** `task`; `family`, `units`, `given`: as of `family_of`; `found`: realisations; `free`: what
    `canonical_fit` found, None where there is no canonical form; `connections`.
    """
    held = np.isfinite(given)
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
    return sorted(starts, key=lambda start: -start.score), outcome


def consistent_models(task: Task, found, connections: Connections) -> list[MechanicalModel]:
    """Models of the structure whose transfer function a realisation of the record has, the best first, not refined."""
    known, _ = known_elements(task, connections)
    _, family, _, given = family_of(task, connections, known)
    starts = [_begun(task, family, match) for match in _consistent(family, _matches(task, family, found, given))]
    return [model_of(task, one, one, known) for one in starts]


def known_elements(task: Task, connections: Connections) -> tuple[dict[tuple[str, int], float], bool]:
    """Elements that are given, in the record's units; and whether the first mass is set to 1 among them: where none is
    given, an excited base leaves the scale of masses open."""
    known = fixed_elements(task.request.fix, connections)
    normalised = not isinstance(task.drive, Force) and not any(owner == "mass" for owner, _ in known)
    return (known | {("mass", 0): 1.0} if normalised else known), normalised


def family_of(task: Task, connections: Connections, known):
    """A structure in the units of the task: its assemblies, its transfer functions, the units of its elements, and the
    elements that are given, NaN for the others."""
    form = connections.structure.scaled(np.asarray(task.scaling.coordinates))
    units = _element_units(task, form)
    position = {"mass": 0, "damping": task.dofs, "stiffness": task.dofs + len(connections.dampers)}
    given = np.full(len(units), np.nan)
    for (owner, k), value in known.items():
        given[position[owner] + k] = value * units[position[owner] + k]
    return form, Family.of(form, task.setting), units, given


def _matches(task: Task, family: Family, found, given) -> list[tuple[float, np.ndarray, tuple]]:
    """What the structure makes of every realisation, the best match first: its error, parameters, the realisation."""
    matches = []
    for model, tau, rows in (one for some in (found, *high_passed_realizations(task)) for one in some[:MOST_TRIED]):
        with contextlib.suppress(ComputationError, np.linalg.LinAlgError):
            ends = matched(family, *_target(task, model, None), given, starts=FEW_STARTS)
            theta = np.where(np.isfinite(given), np.nan_to_num(given), ends.parameters[0])
            if np.isfinite(ends.errors[0]):
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


def _element_units(task: Task, form: Structure) -> Float[np.ndarray, " parameters"]:
    """Scaled parameters for one unit of every mass, damper and spring."""
    T = float(task.scaling.sampling_time)
    masses = np.asarray(task.scaling.coordinates) ** 2
    return np.concatenate([masses / T**2, form.damping.units / T, form.stiffness.units])
