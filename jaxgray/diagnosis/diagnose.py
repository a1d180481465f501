"""What the simulation gets wrong, why, and what mending it buys: the pipeline, nothing else."""

import dataclasses
import difflib
import functools
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from ..identification import Identification
from ..identification.identify_hidden import other_models
from ..identification.validation.structure_test import StructureTest
from ..mechanics.effects import CATALOGUE, MODEL_ERRORS
from ..mechanics.effects.base import AbstractEffect
from ..mechanics.linear import corrected
from ..mechanics.model import MechanicalModel
from ..numerics.outcomes import ComputationError
from ..numerics.programs.runtime import ready, relieve, undisturbed
from ..numerics.progress import AbstractProgress, Budgeted, Silent
from ..numerics.text import listed
from ..records import Record, check_compatible, preflight, records_of
from ..records.checks.finding import SEVERITIES
from ..records.cleaning import without_defects
from . import settings
from .conclusions.assembly import (
    accepted_names,
    budget_of,
    curves_of,
    findings_of,
    matrix_errors,
    model_of,
    not_found_of,
    open_scale,
    picked_up,
    shifts_of,
    summary_of,
)
from .conclusions.candidates import gate_of, rejected_of
from .conclusions.explainable import explainable_share
from .conclusions.next_experiment import next_experiment
from .conclusions.physics import energy_of, unphysical
from .data_checks.extrapolation import beyond_the_fit
from .data_checks.output_offsets import from_own_zeros
from .data_checks.record_findings import noise_findings, record_findings, still_spoilt
from .data_checks.residual_outliers import merged, without_late_outliers
from .data_checks.sample_size import check_enough
from .estimation.context import SearchContext
from .estimation.measured_motion import FORCES
from .findings import Finding
from .model.baseline import ADOPTED, Baseline, baseline_of, others_of
from .model.candidate import Candidate, Data
from .model.compile_ahead import compiling_ahead
from .model.free_run import FreeRun, overall
from .model.held_out_gain import gain_of
from .model.own_laws import laws_of, owner_of, parameter_errors
from .model.simulator import Simulator, steps_of
from .noise.floor import independent_floor, residual_rms
from .own_simulator import diagnose_simulator
from .result import Diagnosis
from .routing import (
    ForceEquation,
    asked_of_forces,
    begin,
    by_accelerations,
    by_force_equation,
    force_equation_trials,
    may_converge_in_phase,
)
from .screening.flexible_force import FlexibleForce
from .search.forward import recount
from .search.parts import Searched, search
from .search.state import SearchState
from .simulated_outputs import as_if_measured, stand_in
from .stamped import diagnose_stamped
from .starts.user_model import identified, with_first_states

NO_PLACES = (
    "Without a structure hidden coordinates are those of the canonical form, which are no places: laws were looked for "
    "at the measured ones alone. Name the connections, such as structure='y1-h1, h1-ground', to look at all."
)
"""What is said of a diagnosis with hidden coordinates in the canonical form."""

PASSES = 3
"""Times that outliers are looked for in what the linear model leaves."""


@undisturbed()
def diagnose(
    record: Record | list[Record],
    *,
    validation: Record | list[Record] | None = None,
    model: MechanicalModel | None = None,
    simulator: Callable | None = None,
    parameters: Mapping[str, float] | None = None,
    workers: int = 1,
    simulated: Float[np.ndarray, "samples outputs"] | None = None,
    catalogue: tuple[AbstractEffect, ...] = CATALOGUE,
    only=None,
    exclude=None,
    max_effects: int = 4,
    holdout: float = 0.3,
    seed: int = 0,
    budget: float | None = None,
    progress: AbstractProgress | None = None,
    **options,
) -> Diagnosis:
    """Show what a simulation gets wrong on a measured record, name the cause, mend it, and measure the gain.

    **Arguments:**

    - `record`: one record, or several of the same system.
    - `validation`: records that the fit does not see; default the last part of the record.
    - `model`: the user's own model, judged as it is, with its effects: which of its numbers are wrong, then what it
      lacks; default the model identified from the record.
    - `simulator`: the user's own simulation y = f(u, w, θ) in the place of a model, of one whole record from its start:
      inputs (samples × inputs), forces w at the coordinates of the outputs (samples × outputs, held as the inputs are)
      and numbers θ by name → displacements (samples × outputs). The result says which of its numbers are off, then
      which laws it lacks. Where none of its runs follows the record (an arm held upright), one that also has `momenta`,
      `forces` and `windows`, as `MujocoSimulator` has, is judged by the balance of its forces along the measured
      motion.
    - `parameters`: θ as the simulator has them; a number keeps its sign, and one that is 0 does not become negative.
    - `workers`: processes that run the simulator side by side (it must then be importable); default 1.
    - `simulated`: outputs of the user's own simulation for the record's inputs, where nothing else is known of it: a
      model that reproduces them takes its place.
    - `catalogue`: effects to look for; append your own.
    - `only`, `exclude`: ids of effects to look for alone, or to leave out; default none.
    - `max_effects`: how many effects may be added; default 4.
    - `holdout`: share of the record held out where no validation is given; default 0.3.
    - `seed`: of the resampling; default 0.
    - `budget` [s]: time after the call at which the search ends with the best that is accepted by then; the linear fit,
      the refit in progress and the summary are finished even so. Default no limit.
    - `progress`: told of every stage; silent by default.
    - `options`: as for `identify` (excitation, input_map, structure, fix, hidden, time_constants, …). With `hidden`
        coordinates and the connections of a structure, laws are looked for between and at hidden ones as well.

    **Returns:** a `Diagnosis`.

    **Raises:** `ValueError` for arguments or data that cannot serve; `ComputationError` when a computation fails.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-2.0, -1.0, 1.0, 2.0], 50), 20)
        >>> q, v, y = 0.0, 0.0, np.zeros(1000)
        >>> for k in range(1000):
        ...     y[k] = q
        ...     for _ in range(20):
        ...         v += 0.0005 * (u[k] - 3 * v - 80 * q - 0.3 * np.tanh(v / 1e-3)) / 2
        ...         q += 0.0005 * v
        >>> record = jaxgray.Record(u, y + 1e-4 * rng.standard_normal(1000), 0.01)
        >>> found = jaxgray.diagnose(record, only=["coulomb_friction"])
        >>> found.verdict, found.findings[0].effect
        ('named', 'coulomb_friction')
        >>> round(found.findings[0].parameters["Fc"].value, 1)
        0.3
    """
    ready()
    relieve()
    if budget is not None and not budget > 0:
        raise ValueError(f"budget={budget!r}; give a positive time in seconds, or None for no limit.")
    progress = Budgeted(Silent() if progress is None else progress, budget)
    if not isinstance(max_effects, int) or max_effects < 0:
        raise ValueError(f"max_effects={max_effects!r}; give a whole number, 0 or more.")
    searched = chosen_effects(catalogue, only, exclude)
    for name, given in (("model", model), ("simulator", simulator), ("simulated", simulated)):
        if given is not None and "hidden" in options:
            raise ValueError(f"hidden is about a model that is fitted; leave it out with {name}.")
    records = records_of(record, "record")
    held = [] if validation is None else records_of(validation, "validation")
    if any(one.has_own_times for one in records + held):
        if given := [name for name, value in (("simulator", simulator), ("simulated", simulated)) if value is not None]:
            raise ValueError(
                f"{given[0]} runs at a uniform sampling time, and the record has rows at times of its own; give "
                "record.on_grid, or a model."
            )
        settled = {"catalogue": catalogue, "only": only, "exclude": exclude, "max_effects": max_effects}
        settled |= {"holdout": holdout, "seed": seed, "progress": progress, "model": model}

        def judge(uniform, unseen):
            return diagnose(uniform, validation=unseen or None, **settled, **options)

        found = diagnose_stamped(judge, records, held, model, progress.unlimited, options)
        return _ended(found, progress, budget)
    if simulated is not None:
        judged = {"model": model, "simulator": simulator, "parameters": parameters}
        if given := [name for name, value in judged.items() if value is not None]:
            raise ValueError(f"simulated and {listed(given)} are different things to judge; give one of them.")
        settled = {"catalogue": catalogue, "only": only, "exclude": exclude, "max_effects": max_effects}
        settled |= {"holdout": holdout, "seed": seed, "progress": progress}
        return _ended(_of_simulated_outputs(record, validation, simulated, settled, options), progress, budget)
    if simulator is not None:
        found = _of_simulator(
            simulator,
            parameters,
            workers,
            records,
            held,
            model,
            searched,
            max_effects,
            holdout,
            seed,
            progress,
            options,
        )
        return _ended(found, progress, budget)
    if parameters is not None:
        raise ValueError("parameters are those of a simulator; give simulator=, a function of inputs, forces, numbers.")
    separate = validation is not None or len(records) > 1
    if validation is None and separate:
        records, held = records[:-1], records[-1:]
    elif not separate:
        first, last = records[0].split(holdout)
        records, held = [first], [last]
    check_compatible(records + held)
    if model is not None:
        model = corrected(model)
        searched = wrong_numbers(model, records[0]) + searched
    used, unseen = [without_defects(r) for r in records], [without_defects(r) for r in held]
    check_enough(used, unseen)
    with compiling_ahead(used, FORCES, searched, model, options):
        found = _of_clean_records(used, unseen, separate, model, searched, max_effects, seed, progress, options)
    cleaned = [*used, *found.records]
    messages = [
        {finding.message for one in group for finding in preflight(one, relations=False)}
        for group in (records, cleaned)
    ]
    warnings = tuple(text for text in found.warnings if text in messages[0] or text not in messages[1])
    # What is wrong between channels is no law, and looks like many.
    beside = (finding for finding in preflight(records[0]) if finding.severity != SEVERITIES[0])
    warnings += tuple(one.message for one in beside if one.message not in messages[0])
    found = dataclasses.replace(found, findings=merged(record_findings(records[0]) + found.findings), warnings=warnings)
    return _ended(found, progress, budget)


def _other_models(records: list[Record], baseline: Baseline, progress: AbstractProgress, options: dict):
    """What gives other linear models of a structure with hidden coordinates, found once however often it is called."""

    @functools.cache
    def others() -> tuple[Candidate, ...]:
        progress.stage("looking for other linear models")
        try:
            return others_of(records, baseline, other_models(records, options, progress.unlimited))
        except (ComputationError, np.linalg.LinAlgError):
            return ()

    return others


def _ended(found: Diagnosis, progress: Budgeted, budget: float | None) -> Diagnosis:
    """A diagnosis that says where its budget of time ended the search."""
    if progress.ended is None:
        return found
    words = f"The search ended after its budget of {budget:g} s, before {progress.ended}: not everything was tried."
    return dataclasses.replace(found, warnings=(words, *found.warnings))


def _of_clean_records(
    records: list[Record], held: list[Record], separate: bool, model, searched, max_effects, seed, progress, options
) -> Diagnosis:
    """The diagnosis of records without spoilt samples."""
    identification, outliers = None, ()
    equation = ForceEquation(searched, max_effects, seed, progress)
    if model is None:
        identification = begin(records, held, equation, options)
        if isinstance(identification, Identification):
            # The largest hide the others.
            for _ in range(PASSES):
                before = records + held
                records, held, more = without_late_outliers(records, held, identification)
                if all(now is then for now, then in zip(records + held, before)):
                    break
                outliers += more
                identification = begin(records, held, equation, options)
                if isinstance(identification, Diagnosis):
                    break
        if isinstance(identification, Diagnosis):
            # No free run of the linear model is usable: decided on another route.
            return dataclasses.replace(identification, findings=outliers + identification.findings)
    anew: tuple[str, ...] = ()
    if separate:
        plain = identification.model if model is None else lasting(model, records[0])
        from_zero, anew = from_own_zeros(records + held, plain)
        records, held = from_zero[: len(records)], from_zero[len(records) :]
    baseline = baseline_of(records, identification, model)
    floor, source = independent_floor(records[0])
    fitted, unseen = identification is not None, bool(baseline.model.hidden)
    data = [Data.of(r) for r in records]
    longest = max(len(d.u) for d in data)
    context = SearchContext(
        Simulator(baseline.setup, FORCES, steps=steps_of(baseline.model, records[0].sampling_time)),
        data,
        [Data.of(r, longest) for r in held],
        searched,
        (records[0].input_names, records[0].output_names),
        baseline.setup.held,
        floor,
        separate,
        np.random.default_rng(seed),
        progress,
        forces=asked_of_forces(records, held, identification, equation, options),
        first_trials=force_equation_trials(records, equation, options) if fitted and not unseen else None,
        trials_at_once=by_accelerations(records, options),
        out_of_phase=fitted and may_converge_in_phase(identification),
        others=_other_models(records, baseline, progress, options) if unseen and baseline.setup.physical else None,
    )
    if model is not None:
        context = dataclasses.replace(context, identified=identified(context.simulator, records, context.data, options))
        baseline = with_first_states(context, baseline)
    errors = MODEL_ERRORS + parameter_errors(baseline.setup.own) if baseline.own else ()

    state, searched = search(context, baseline, max_effects, errors=errors)
    progress.unlimited.stage("summing up")
    # What no law explains has a colour of its own, and follows the inputs: it says nothing of the noise.
    noise = () if state.unexplained else noise_findings(records[0], state.stage.e, state.screening.noise_model)
    found = _assembled(context, state, searched, baseline, identification, records, held, floor, source, noise)
    found = by_force_equation(found, context.forces)
    if searched.where is not None:
        anew += (f"{searched.where}; every number is of the refit on the whole record.",)
    if not baseline.setup.physical and baseline.setup.hidden:
        anew += (NO_PLACES,)
    warnings = baseline.left_out + anew + beyond_the_fit(records, held) + found.warnings
    return dataclasses.replace(found, findings=outliers + found.findings, warnings=warnings)


def _of_simulated_outputs(record, validation, simulated, settled: dict, options: dict) -> Diagnosis:
    """The diagnosis of a simulation of which only the outputs are known."""
    if not isinstance(record, Record):
        raise ValueError("simulated outputs are those of one record's inputs; give that record alone.")
    shown = as_if_measured(record, simulated, settled["seed"])
    settled["progress"].unlimited.stage("finding what moves as your simulation does")
    model, stands_in = stand_in(diagnose(shown, **settled, **options))
    # The structure is that of the simulation; the machine need not have it.
    options = {name: value for name, value in options.items() if name not in ("structure", "fix")}
    settled["progress"].unlimited.stage("comparing it with what was measured")
    found = diagnose(record, validation=validation, model=model, **settled, **options)
    return dataclasses.replace(found, simulated=stands_in)


def _of_simulator(
    simulator, parameters, workers, records, held, model, searched, max_effects, holdout, seed, progress, options
) -> Diagnosis:
    """The diagnosis of the user's own simulator, which runs every record from its start."""
    if model is not None or options:
        more = ", ".join(["model"] * (model is not None) + sorted(options))
        raise ValueError(f"{more} given with a simulator, which says itself how the system moves; leave it out.")
    check_compatible(records + held)
    if not held and len(records) > 1:
        records, held = records[:-1], records[-1:]
    separate = bool(held)
    whole, unseen = [without_defects(r) for r in records], [without_defects(r) for r in held]
    if separate:
        spans = [(r, slice(0, r.samples), None) for r in whole] + [(r, None, slice(0, r.samples)) for r in unseen]
    else:
        cut = whole[0].split(holdout)[0].samples
        spans = [(whole[0], slice(0, cut), slice(cut, whole[0].samples))]
    check_enough(
        [r[fit] for r, fit, _ in spans if fit is not None], [r[part] for r, _, part in spans if part is not None]
    )
    found = diagnose_simulator(
        simulator,
        parameters,
        spans,
        catalogue=searched,
        max_effects=max_effects,
        separate=separate,
        seed=seed,
        workers=workers,
        progress=progress,
    )
    return dataclasses.replace(found, findings=merged(record_findings(records[0]) + found.findings))


def chosen_effects(catalogue, only, exclude) -> tuple[AbstractEffect, ...]:
    """The effects to look for.

    **Raises:** `ValueError` for an id that is not in the catalogue.
    """
    known = {effect.id: effect for effect in catalogue}

    def ids(name, given):
        if given is None:
            return None
        given = [g.strip() for g in given.split(",")] if isinstance(given, str) else list(given)
        for item in given:
            if item not in known:
                near = difflib.get_close_matches(item, known, n=1)
                hint = f" (did you mean {near[0]!r}?)" if near else ""
                raise ValueError(f"{name}: {item!r} is not in the catalogue{hint}; see `jaxgray effects`.")
        return set(given)

    wanted, unwanted = ids("only", only), ids("exclude", exclude) or set()
    return tuple(e for e in catalogue if (wanted is None or e.id in wanted) and e.id not in unwanted)


def lasting(model: MechanicalModel, record: Record) -> MechanicalModel:
    """A given model without the effects that belong to the clock of one record."""
    return dataclasses.replace(model, effects=laws_of(model, record)[0])


def wrong_numbers(model: MechanicalModel, record: Record) -> tuple[AbstractEffect, ...]:
    """What may be wrong of a given model: entries of its matrices, and numbers of its laws."""
    return MODEL_ERRORS + parameter_errors(laws_of(model, record)[0])


def _assembled(
    context: SearchContext,
    state: SearchState,
    searched: Searched,
    baseline,
    identification: Identification | None,
    records,
    held,
    floor,
    source,
    noise,
):
    setup, data = context.simulator.setup, context.data[0]
    if floor is None:
        floor = residual_rms(state.stage.e, data)
    recount(context, state, floor)
    names = records[0].output_names
    start_run = FreeRun(state.start.motion.y, state.start.e, data.kept)
    last_run = FreeRun(state.stage.motion.y, state.stage.e, data.kept)
    errors = None if identification is None else identification.standard_errors
    # Where nothing holds the body, the search begins with another one.
    moved = not np.array_equal(state.start.candidate.entries, baseline.start.entries)
    begun = model_of(state.start.candidate, baseline.model, setup) if moved else baseline.model
    base = summary_of(begun, errors, start_run, state.baseline_runs, records, held)
    base_excess = overall(residual_rms(state.start.e, data), floor)
    excess = overall(residual_rms(state.stage.e, data), floor)
    findings = list(findings_of(context, state, records[0]))
    extended = gain = None
    shifts = ()
    if state.accepted:
        mended = model_of(state.fit.candidate, baseline.model, setup)
        spread = matrix_errors(state.fit, setup)
        extended = summary_of(mended, spread, last_run, state.runs, records, held)
        shifts = shifts_of(begun, mended, spread)
        if state.runs:
            # What is tied to the clock of the fit does not show on held-out data.
            held_out = any(accepted.gain.held_out for accepted in state.accepted)
            seen = [start_run], [last_run], [start_run]
            runs = (state.baseline_runs, state.runs, state.baseline_runs) if held_out else seen
            gain = gain_of(*runs, floor, names, held_out=held_out, rng=context.rng, seen=seen)
            if len(state.accepted) == 1:
                # The same, from the same draws: one finding must not have two intervals.
                gain = state.accepted[0].gain
    mends_model = any(accepted.stage == "model" for accepted in state.accepted)
    unexplained = state.unexplained or (source != ADOPTED and excess >= settings.MIN_EXCESS)
    test = None if identification is None else identification.structure_test
    if not state.accepted and test is not None and _misfits(test, state):
        unexplained = True
    unexplained = unexplained or _fails_elsewhere(state, records, held, floor)
    depends = _depends_on(state) if unexplained else ()
    if unexplained and not mends_model:
        worst = int(np.argmax(residual_rms(state.stage.e, data) / floor))
        findings.append(Finding("unexplained", names[worst], "unexplained", "model", (), {}, None, None))
    model_findings = [f.status for f in findings if f.stage == "model"]
    if unexplained:
        verdict = "partly" if mends_model else "unexplained"
    else:
        verdict = "equivalent" if "equivalent" in model_findings else "named" if model_findings else "noise"
    warnings = open_scale(state, setup, names) + picked_up(state, names)
    warnings += () if identification is None else _own_warnings(identification, state)
    shown = base.model if extended is None else extended.model
    energy = energy_of(shown, records[0], state.stage.candidate.x0[0])
    warnings += unphysical(shown, energy)
    taken = accepted_names(state.accepted)
    return Diagnosis(
        verdict=verdict,
        baseline=base,
        noise_floor=dict(zip(names, map(float, floor))),
        noise_floor_source=source,
        findings=noise + tuple(findings),
        extended=extended,
        gain=gain,
        excess=excess,
        baseline_excess=base_excess,
        white=not state.unexplained and state.screening.noise_model.ratio == 0.0,
        explainable=explainable_share(searched.context, searched.state, floor) if unexplained else None,
        depends_on=depends,
        rejected=rejected_of(context, state, records[0]),
        not_found=not_found_of(state.screening, context, records[0], taken),
        shifts=shifts,
        budget=budget_of(state, context, floor, all_noise=source != ADOPTED or not unexplained),
        next_experiment=_experiment(context, state, records[0], floor),
        warnings=warnings,
        records=tuple(records),
        validation_records=tuple(held),
        curves=curves_of(context, state, records, held),
        identification=identification,
        terms=state.stage.candidate.terms,
        own_model=baseline.own,
        gate=gate_of(state),
        energy=energy,
    )


def _misfits(test: StructureTest, state: SearchState) -> bool:
    """Whether M, D, K do not fit by the test of the identification, which takes colour of the noise for a little more
    of dynamics."""
    noise_model, share = state.screening.noise_model, 0.0
    if noise_model.ratio > 0.0:
        share = 2 * settings.MISFIT_SHARE
    elif np.any(np.diag(noise_model.lower) < settings.WHITE_INNOVATIONS * noise_model.level):
        share = settings.MISFIT_SHARE
    return test.p_value < settings.MISFIT_PROBABILITY and test.explained_percent > share


def _fails_elsewhere(state: SearchState, records, held, floor) -> bool:
    """Whether all held-out records show more than noise: what the data of the fit pass off as slow noise or follow by
    laws of their own. Not where a law is tied to the clock of the fit or had to be extrapolated."""
    if state.screening.noise_model.ratio > 0.0:
        return False
    if state.accepted and (not all(one.gain.held_out for one in state.accepted) or beyond_the_fit(records, held)):
        return False
    sound = [run for run, record in zip(state.runs, held) if not still_spoilt(record)]
    return bool(sound) and min(overall(run.rmse, floor) for run in sound) >= settings.MIN_HELD_OUT_EXCESS


def _experiment(context: SearchContext, state: SearchState, record: Record, floor):
    """The experiment that separates the first class that the record leaves open and some input can close."""
    progress = context.progress.unlimited
    for accepted in (one for one in state.accepted if one.rivals):
        members = [state.fit.candidate, *(rival.fit.candidate for rival in accepted.rivals)]
        ids = tuple(attempt.name[0] for attempt in (accepted.attempt, *accepted.rivals))
        found = next_experiment(context, members, ids, record, floor, progress=progress)
        if found is not None:
            return found
    return None


def _depends_on(state: SearchState) -> tuple[str, ...]:
    """Variables on which what is left depends: of the best candidates of the last look."""
    words = []
    families = {
        "stiffness": "displacement",
        "friction": "velocity",
        "hysteresis": "the history of displacement",
        "coupling": "motion of other coordinates",
        "actuator": "input",
        "sensor": "output",
        "structure": "frequency or time",
        "disturbance": "time",
    }
    for score in list(state.screening.best_by_effect().values())[:3]:
        if score.delta_bic > 0 and score.shape.effect.id != FlexibleForce.id:
            family = owner_of(score.shape.effect).family
            words.append(f"{families.get(family, family)} ({score.shape.place.name})")
    return tuple(dict.fromkeys(words))


def _own_warnings(identification: Identification, state: SearchState) -> tuple[str, ...]:
    """Warnings of the linear fit; what a finding has mended is no longer one."""
    if not state.accepted:
        return identification.warnings
    return tuple(text for text in identification.warnings if text not in identification.misfits)
