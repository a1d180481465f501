"""From what the loop found to a `Diagnosis`: parameters with units, tables, budget and verdict."""

import dataclasses

import jax
import numpy as np

from ...identification.validation.residuals import fit_of
from ...mechanics.effects.base import AbstractInputEffect, AbstractOutputEffect, Term
from ...mechanics.model import MechanicalModel
from ...mechanics.systems.units import composed_unit, displacement_unit
from ...numerics.programs.stored_programs import ONCE, stored
from ...numerics.responses.filters import white_part
from ...records import Record
from ..estimation.change_points import change_point_errors
from ..estimation.context import SearchContext
from ..estimation.element_sums import at_one_threshold, elements_of
from ..estimation.gauss_newton import Refit
from ..findings import Curves, Estimate, Finding, Member, ModelSummary, NotFound, ParameterShift
from ..model.candidate import Candidate, Setup
from ..model.free_run import FreeRun
from ..model.own_laws import ParameterError, completed, owner_of
from ..model.parameter_vector import Layout
from ..noise.floor import residual_rms
from ..screening.flexible_force import FlexibleForce
from ..screening.score_test import Screening
from ..search.state import Accepted, SearchState
from ..words.titles import place_of, title_of


def units_at(term: Term, record: Record, per_mass: bool) -> dict:
    """Units of force and length for the parameters of a term, and whether its forces are those on a mass of one: of a
    law, of the displacement whatever the sensor measures; of an input or a sensor, of what it gives."""
    first, law = max(term.place.first, 0), owner_of(term.effect)
    if isinstance(law, AbstractOutputEffect):
        return {"force": record.input_units[0], "length": record.output_units[first]}
    at_input = isinstance(law, AbstractInputEffect) or law.places == "input"
    output = min(first, record.outputs - 1)
    return {
        "force": record.input_units[first if at_input else min(first, record.inputs - 1)],
        "length": displacement_unit(record.output_units[output], record.measured[output]),
        "per_mass": per_mass and not at_input,
    }


def estimates_of(
    term: Term, errors: dict[int, float], record: Record, *, per_mass: bool = False
) -> dict[str, Estimate]:
    """Parameters of a term by symbol; those of the same name as one list, elements at one threshold as one element.

    **Arguments:** `term`; `errors`: standard error by position, for those that were estimated; `record`; `per_mass`:
    under a moving base, where forces are those on a mass of one.
    """
    units = units_at(term, record, per_mass)
    result: dict[str, Estimate] = {}
    for j, (parameter, value) in enumerate(zip(term.effect.parameters, np.asarray(term.values, float))):
        unit = composed_unit(parameter.unit, **units)
        if parameter.choices:
            result[parameter.name] = Estimate(parameter.choices[int(round(float(value)))], None, "")
            continue
        new = Estimate(float(value), errors.get(j), unit)
        if parameter.name in result:
            old = result[parameter.name]
            values = old.value if isinstance(old.value, tuple) else (old.value,)
            spread = old.standard_error if isinstance(old.standard_error, tuple) else (old.standard_error,)
            new = Estimate((*values, new.value), (*spread, new.standard_error), unit)
        result[parameter.name] = new
    for elements in elements_of(term.effect)[:1]:
        size, threshold = (term.effect.parameters[j].name for j in elements)
        result |= dict(zip((size, threshold), _joined(result[size], result[threshold])))
    return result


def _joined(size: Estimate, threshold: Estimate) -> tuple[Estimate, Estimate]:
    """Elements of a sum with those at one threshold as one. They share its size in equal parts, with one error between
    them: their responses are the same, and only the sum of their sizes was estimated."""
    groups = at_one_threshold(threshold.value)

    def together(values, how):
        return tuple(None if values[g[0]] is None else float(how([values[j] for j in g])) for g in groups)

    return (
        Estimate(together(size.value, sum), together(size.standard_error, sum), size.unit),
        Estimate(together(threshold.value, np.mean), together(threshold.standard_error, np.mean), threshold.unit),
    )


def term_errors(fit: Refit, setup: Setup, index: int) -> dict[int, float]:
    """Standard errors of one term's parameters, by position. Of elements at one threshold only the sum of their sizes
    and the mean of their thresholds is determined, whose errors they share."""
    layout, term = Layout(setup, fit.candidate), fit.candidate.terms[index]
    at = {j: layout.first + position for position, (k, j) in enumerate(layout.terms) if k == index}
    errors = {j: float(np.sqrt(max(fit.covariance[here, here], 0.0))) for j, here in at.items()}
    elements = elements_of(term.effect)
    for group in at_one_threshold([float(term.values[threshold]) for _, threshold in elements]):
        for own in zip(*(elements[k] for k in group)) if len(group) > 1 else ():
            rows = [at[j] for j in own]
            shared = float(np.sqrt(max(fit.covariance[np.ix_(rows, rows)].sum(), 0.0))) / len(own)
            errors |= dict.fromkeys(own, shared)
    return errors


def findings_of(context: SearchContext, state: SearchState, record: Record) -> tuple[Finding, ...]:
    """Everything that was accepted, with the class of each, what gains most first."""
    found = []
    for k, accepted in enumerate(state.accepted):
        members = [_member(context, state.fit or accepted.attempt.fit, k, record, 0.0)]
        for rival in accepted.rivals:
            # A commoner law stands first though another explains a little more.
            difference = min(accepted.attempt.criterion - rival.criterion, 0.0)
            at = [(t.effect.id, t.place.name) for t in rival.fit.candidate.terms].index(rival.name)
            members.append(_member(context, rival.fit, at, record, difference))
        found.append(
            Finding(
                *accepted.attempt.name,
                "named" if len(members) == 1 else "equivalent",
                accepted.stage,
                tuple(members),
                members[0].parameters,
                float(accepted.attempt.delta_bic),
                accepted.gain,
                found_by=accepted.move.value,
            )
        )
    return tuple(sorted(found, key=lambda finding: -finding.gain.percent))


def _member(context: SearchContext, fit: Refit, index: int, record: Record, difference: float) -> Member:
    setup = context.simulator.setup
    term, errors = fit.candidate.terms[index], term_errors(fit, setup, index)
    errors = errors | change_point_errors(context, fit, index, errors)
    parameters = estimates_of(term, errors, record, per_mass=setup.per_mass)
    if isinstance(term.effect, ParameterError):
        delta = parameters["delta"]
        parameters["value"] = dataclasses.replace(delta, value=term.effect.value + delta.value)
    return Member(term.effect.id, term.place.name, float(difference), parameters)


def model_of(candidate: Candidate, like: MechanicalModel, setup: Setup) -> MechanicalModel:
    """The model of a candidate, its terms among its effects."""
    M, D, K = (np.asarray(X) for X in setup.matrices(np.asarray(candidate.entries)))
    return MechanicalModel(
        (M + M.T) / 2,
        (D + D.T) / 2,
        (K + K.T) / 2,
        drive=like.drive,
        measured=like.measured,
        input_names=like.input_names,
        output_names=like.output_names,
        input_units=like.input_units,
        output_units=like.output_units,
        effects=completed(candidate, setup.own).terms,
        hidden=like.hidden,
    )


@stored(level=ONCE)
def _slopes(matrices, entries):
    return jax.jacfwd(matrices)(entries)


def matrix_errors(fit: Refit, setup: Setup) -> dict[str, np.ndarray]:
    """Standard errors of every entry of mass, damping and stiffness."""
    entries = np.asarray(fit.candidate.entries)
    slopes = _slopes(setup.matrices, entries)
    covariance = fit.covariance[: len(entries), : len(entries)]
    return {
        name: np.sqrt(np.maximum(np.einsum("ijk,kl,ijl->ij", J, covariance, J), 0.0))
        for name, J in zip(("mass", "damping", "stiffness"), map(np.asarray, slopes))
    }


def summary_of(
    model: MechanicalModel, errors, estimation: FreeRun, validation: list[FreeRun], records: list[Record], held: list
) -> ModelSummary:
    """Fits of one model on both kinds of data; the held-out ones without the head that gave the first state."""
    fits = {"estimation": _fit(records[:1], [estimation])}
    if validation:
        fits["validation"] = _fit(held, validation)
    names = model.output_names
    return ModelSummary(
        model,
        errors,
        {kind: dict(zip(names, map(float, fit[0]))) for kind, fit in fits.items()},
        {kind: dict(zip(names, map(float, fit[1]))) for kind, fit in fits.items()},
    )


def _fit(records, runs):
    measured, simulated = [], []
    for record, run in zip(records, runs):
        n = record.samples
        keep = run.kept[:n]
        measured.append(np.where(keep, record.y, np.nan))
        simulated.append(run.simulated[:n])
    fit = fit_of(np.concatenate(measured), np.concatenate(simulated))
    return fit.fit_percent, fit.rmse


def shifts_of(before: MechanicalModel, after: MechanicalModel, errors) -> tuple[ParameterShift, ...]:
    """What every entry of M, D, K was with and without the terms."""
    result = []
    for name in ("mass", "damping", "stiffness"):
        old, new = np.asarray(getattr(before, name)), np.asarray(getattr(after, name))
        for r in range(len(old)):
            for c in range(r, len(old)):
                error = None if errors is None else float(errors[name][r, c])
                result.append(ParameterShift(f"{name}[{r},{c}]", float(old[r, c]), float(new[r, c]), error))
    return tuple(result)


def not_found_of(
    screening: Screening, context: SearchContext, record: Record, taken: frozenset
) -> tuple[NotFound, ...]:
    """Every other candidate, with the smallest size that would have been seen in this record."""
    result = []
    for (effect, place), score in screening.best_by_place().items():
        if effect == FlexibleForce.id or (effect, place) in taken or score.delta_bic >= screening.threshold:
            continue
        shape = score.shape
        values = np.array(shape.values, float)
        amplitudes = [j for j, p in enumerate(shape.effect.parameters) if p.amplitude]
        values[amplitudes] = np.abs(values[amplitudes]) * score.smallest
        term = Term(shape.effect, shape.place, values)
        smallest = estimates_of(term, {}, record, per_mass=context.simulator.setup.per_mass)
        names = [shape.effect.parameters[j].name for j in amplitudes] or list(smallest)
        result.append(NotFound(effect, place, {name: smallest[name] for name in names}))
    return tuple(result)


def budget_of(state: SearchState, context: SearchContext, floor: np.ndarray, *, all_noise: bool) -> dict[str, float]:
    """Share of every finding, noise and the unexplained in the mean square error of the baseline, in percent.

    **Arguments:** `floor` per output; `all_noise`: whether all that is left may be noise; otherwise no more than its
    white part is.
    """
    data = context.data[0]

    def power(e):
        return float(np.mean((residual_rms(e, data) / floor) ** 2))

    before = power(state.start.e)
    shares, last = {}, before
    for accepted in state.accepted:
        now = power(accepted.attempt.fit.residual[0])
        shares[f"{accepted.attempt.name[0]} at {accepted.attempt.name[1]}"] = 100 * (last - now) / before
        last = now
    most = 1.0 if all_noise else float(np.mean(white_part(state.stage.e, data.kept) / floor**2))
    noise = min(most, last)
    return {**shares, "noise": 100 * noise / before, "unexplained": 100 * (last - noise) / before}


def curves_of(
    context: SearchContext, state: SearchState, records: list[Record], held: list[Record]
) -> tuple[Curves, ...]:
    """Series for the figures: the estimation record, then those held out."""
    result = []
    pairs = [(records[0], state.start.motion.y, state.stage.motion.y, False)]
    for record, before, after in zip(held, state.baseline_runs, state.runs):
        pairs.append((record, before.simulated, after.simulated, True))
    for record, before, after, held_out in pairs:
        n = record.samples
        result.append(Curves(record.time, record.y, before[:n], after[:n], held_out))
    return tuple(result)


def accepted_names(accepted: list[Accepted]) -> frozenset:
    """Effects and places that were accepted."""
    return frozenset(a.attempt.name for a in accepted)


def open_scale(state: SearchState, setup: Setup, names: tuple[str, ...]) -> tuple[str, ...]:
    """A warning where M, D, K and a law can change together and nothing shows it."""
    if not state.accepted:
        return ()
    layout, loose = Layout(setup, state.fit.candidate), state.fit.undetermined
    if not np.any(loose[: layout.entries]):
        return ()
    owners = {k for (k, _), on in zip(layout.terms, loose[layout.first :]) if on}
    laws = [title_of(t.effect.id, t.place.name, names) for k, t in enumerate(state.fit.candidate.terms) if k in owners]
    beside = f" beside {' and '.join(laws)}" if laws else ""
    return (
        f"This record does not determine all of M, D, K{beside}: some change of several together moves no output, and "
        "the standard errors leave it out. Fix an entry that you know.",
    )


def picked_up(state: SearchState, names: tuple[str, ...]) -> tuple[str, ...]:
    """A warning where a periodic force may be a hum that a sensor picks up."""
    places = [a.attempt.name[1] for a in state.accepted if a.attempt.name[0] == "periodic_disturbance"]
    return tuple(
        f"A hum that the sensor {place_of(place, names)} picks up looks the same as a periodic force there. If the "
        "force is larger than any that acts there, it is a hum: switch off its source, or filter that frequency."
        for place in places
    )
