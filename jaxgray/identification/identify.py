"""From records to a physical model: the pipeline, nothing else."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import scipy.linalg

from ..mechanics.model import MechanicalModel
from ..mechanics.systems.drives import Force
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.programs.runtime import ready, relieve, undisturbed
from ..numerics.progress import AbstractProgress, Silent
from ..records import Record, check_compatible, on_one_grid, preflight, records_of
from .identify_hidden import HiddenRequest, identify_auto, identify_hidden, wants_hidden
from .initialization.base_start import MassKnowledge
from .initialization.guard import lost
from .initialization.rigid import DRIFT, TURNED, phases, rigid_modes, windows, without_stiffness
from .initialization.selection import other_starts, starts_of
from .initialization.start import Start, StartOptions, filled, model_run, nearest_physical, total_deviation
from .refinement.prior import mass_prior
from .refinement.refine import Refinement, start_kept
from .refinement.refine import refine as refine_model
from .refinement.structured_start import is_relaxed, refine_structured, relaxed
from .result import Identification, assess
from .setup.options import drive_of, fixed_entries, parse_fix, pick, scale_to, with_known
from .setup.prediction import Batch, Setting
from .setup.preparation import Signals, prepare, scaling_of
from .setup.structure import Structure, structure_of
from .stamped import identify_stamped
from .subspace.grid import default_time_constants, score, usable_block_rows
from .subspace.projection import WEIGHTS
from .subspace.realization import MAPS
from .validation.reach import check_reach

MOST_STARTS = 3

SLIGHT = 1e-4
"""Ratio of the least to the largest eigenvalue of the scaled mass from which it counts as a mass."""

FASTEST, SHOWN = 2 * np.pi, 0.8 * np.pi
"""Rate of a mode [1/sample], twice that of the fastest motion that samples show, from which inertia hardly shows; and
one at which it does."""

FAST_PRICE = 10.0
"""Fall of −2 ln L from which a faster mode is believed all the same."""

NEAR = 0.05
"""Share of every output's power left by a refinement below which no other start is tried."""


@undisturbed()
def identify(
    record: Record | list[Record],
    *,
    refine: bool = True,
    validation: Record | list[Record] | None = None,
    time_constants=None,
    block_rows=None,
    weight="moesp",
    map="exact",
    input_matrix_from: str = "best",
    excitation: str = "force",
    input_map=None,
    relative: bool = False,
    structure=None,
    fix=None,
    noise: str = "output-error",
    hidden=0,
    progress: AbstractProgress | None = None,
) -> Identification:
    """Mass, damping and stiffness of M q̈ + D q̇ + K q = E u from measured records.

    Subspace start in the λ-operator (and a regression start where that serves better), then prediction-error
    refinement over physically valid matrices.

    **Arguments:**

    - `record`: one record, or several of the same system.
    - `refine`: refine by prediction error (default), or stop at the start.
    - `validation`: records that the fit does not see; their fit is reported.
    - `time_constants`: τ [s] to try, one or several; default a logarithmic grid from the record.
    - `block_rows`: i to try, one or several; default 4, 6, 8, 10 as the record allows.
    - `weight`: "moesp" (default), "n4sid", "cva", "past-inputs", or a weight object.
    - `map`: "exact" (default) or "paper", from the λ-operator to continuous time.
    - `input_matrix_from`: how the subspace start finds the input matrix, from the "record", from the compressed
        "factor", or the "best" of both by free run (default).
    - `excitation`: "force" (default), "base-displacement", "base-acceleration", or "base" (kind by unit).
    - `input_map`: where inputs act: text "u1:y1,u2:y1-y2", a matrix outputs × inputs, or None (input j on the
        coordinate of output j).
    - `relative`: whether outputs are measured relative to a moving base; default False.
    - `structure`: any of "diagonal-mass", "chain", "modal-damping", or connections of named coordinates, "y1-h1,
        h1-h2, h2-ground", each a spring and a damper (":spring" or ":damper" for one alone) between masses of their
        own; default none.
    - `fix`: known entries, "stiffness[0,1]=0,…" or a mapping; in the record's units; default none. With connections
        their names: "mass[h1]=2, stiffness[y1-h1]=100".
    - `noise`: "output-error" (default) or "innovations", when noise enters at the forces too.
    - `hidden`: how many coordinates no output measures, or their names (default 0; h1, h2, …), or "auto". Without
        connections the canonical form is found, in which each is a unit mass of its own.
    - `progress`: told of every stage; silent by default.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for arguments or data that cannot serve; `ComputationError` when a computation
    fails, with the stage and what to try.

    **Reference:** Olofsson, Sörnmo, Robertsson & Johansson, *Continuous-time gray-box identification of
    mechanical systems using subspace-based identification methods*.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> found = jaxgray.identify(record)
        >>> round(float(found.mass[0, 0]), 1), round(float(found.stiffness[0, 0]))
        (2.0, 80)
        >>> bool(abs(found.damping[0, 0] - 3) < 4 * found.standard_errors["damping"][0, 0])
        True
    """
    ready()
    relieve()
    progress = Silent() if progress is None else progress
    records = records_of(record, "record")
    held_out = [] if validation is None else records_of(validation, "validation")
    given = on_one_grid(records + held_out)
    records, held_out = given[: len(records)], given[len(records) :]
    check_compatible(given)
    if any(r.has_own_times for r in records + held_out):
        asked = {"refine": refine, "time_constants": time_constants, "block_rows": block_rows, "weight": weight}
        asked |= {"map": map, "input_matrix_from": input_matrix_from, "excitation": excitation, "input_map": input_map}
        asked |= {"relative": relative, "structure": structure, "fix": fix, "noise": noise, "hidden": hidden}

        def on_grid(uniform, unseen):
            return identify(uniform, validation=unseen or None, progress=progress, **asked)

        return identify_stamped(on_grid, records, held_out, progress)
    notes = _preflight(records)
    if noise not in ("output-error", "innovations"):
        raise ValueError(f"noise={noise!r} is not known; choose 'output-error' or 'innovations'.")
    if input_matrix_from not in ("best", "record", "factor"):
        raise ValueError(f"input_matrix_from={input_matrix_from!r} is not known; choose 'best', 'record' or 'factor'.")
    weight, map = pick("weight", weight, WEIGHTS), pick("map", map, MAPS)
    if wants_hidden(hidden, structure, records[0].output_names):
        request = HiddenRequest(
            structure=structure,
            fix=fix,
            noise=noise,
            excitation=excitation,
            input_map=input_map,
            relative=relative,
            time_constants=time_constants,
            block_rows=block_rows,
            weight=weight,
            map=map,
            refine=refine,
        )
        if hidden == "auto":
            own = {"input_matrix_from": input_matrix_from, "progress": progress}
            return identify_auto(records, held_out, request, notes, partial(identify, **own), progress)
        return identify_hidden(records, held_out, request.named(hidden, records[0].output_names), notes, progress)
    drive = drive_of(records[0], excitation, input_map, relative)
    form = structure_of(structure)
    entries = parse_fix(fix)

    progress.stage("preparing")
    scaling = scaling_of(records)
    based = not isinstance(drive, Force)
    if based and not any(name == "mass" and value != 0.0 for (name, _, _), value in entries.items()):
        entries["mass", 0, 0] = 1.0
        notes.append(
            "Base excitation determines M⁻¹D and M⁻¹K only: the model is normalised to mass[0,0] = 1; give a mass "
            "with fix to set the scale."
        )
    form = form.scaled(np.asarray(scaling.coordinates))
    held, known = fixed_entries(entries, form, scaling)
    setting = Setting(
        jax.device_get(drive).scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time),
        records[0].measured,
        records[0].hold,
    )
    signals = [prepare(r, scaling) for r in records]
    complete = filled(records, scaling, None) if any(r.has_missing for r in records) else signals
    check_reach(complete, records[0].input_names, records[0].output_names)

    mass = None
    if not isinstance(drive, Force):
        held_full, _ = fixed_entries(entries, Structure(), scaling)
        mass = MassKnowledge(mass_prior(Structure(), scaling, known["mass"], held_full), known["mass"])
    options = _start_options(
        records, time_constants, block_rows, weight, map, input_matrix_from, known["mass"], mass, thorough=not refine
    )
    starts = starts_of(complete, setting, scaling.sampling_time, options, progress)
    if complete is not signals:
        runs = [model_run(starts[0].matrices, setting, s)[0] for s in complete]
        complete = filled(records, scaling, runs)
        starts = starts_of(complete, setting, scaling.sampling_time, options, progress)

    def physical(start: Start) -> tuple:
        M, D, K = nearest_physical(start.matrices)
        if based:
            # Base motion determines M⁻¹D and M⁻¹K: they stay as they are where masses are put in.
            M, D, K = (np.asarray(X) * scale_to(known["mass"], M) for X in (M, D, K))
            given = with_known(M, known["mass"])
            D, K = (given @ np.linalg.solve(M, X) for X in (D, K))
            M, D, K = nearest_physical((given, D, K))
        return tuple(with_known(X, known[name]) for X, name in ((M, "mass"), (D, "damping"), (K, "stiffness")))

    start = starts[0]
    M, D, K = physical(start)
    whole = records
    longest = max(r.samples for r in records)
    if rigid_modes(start, longest) and np.max(start.deviation) > DRIFT and not entries:
        records = windows(records)
        signals = [prepare(r, scaling) for r in records]
        form = without_stiffness(form, start, longest)
        held = held[: sum(n * (n + 1) // 2 for n in form.sizes(drive.input_map.shape[0]))]
        notes.append(
            "A rigid body: stiffness is singular, and the free run over the whole record measures drift; the model "
            f"is refined on {len(records)} windows of {records[0].duration:.3g} s."
        )
    batch = Batch.of(signals)
    refinement = None
    if refine:
        held_free, _ = fixed_entries(entries, relaxed(form), scaling)

        def refined(start: Start):
            matrices = physical(start)
            options = {
                "offset": bool(phases(matrices, max(r.samples for r in records))[0] > TURNED),
                "innovations": noise == "innovations",
                "deviation": start.deviation,
            }

            def within(matrices, structure: Structure, fixed, *, near: bool = False) -> Refinement:
                prior = None if isinstance(drive, Force) else mass_prior(structure, scaling, known["mass"], fixed)
                given = {"structure": structure, "fixed": fixed, "prior": prior, "near": near}
                return refine_model(matrices, batch, setting, **given, **options)

            if is_relaxed(form):
                return within(matrices, form, held)
            return refine_structured(matrices, form, held, held_free, within)

        others = partial(other_starts, complete, setting, scaling.sampling_time, options, start, progress)
        start, refinement = _best_refined(starts, others, refined, setting, signals, progress)
        # Of another structure the start is no model to fall back on, with noise at the forces a free run no measure.
        end = refinement.mass, refinement.damping, refinement.stiffness
        comparable = is_relaxed(form) and noise == "output-error"
        if comparable and lost(end, physical(start), setting, [prepare(r, scaling) for r in held_out]):
            prior = None if isinstance(drive, Force) else mass_prior(form, scaling, known["mass"], held)
            offset = refinement.nuisance.offset is not None
            refinement = start_kept(physical(start), batch, setting, structure=form, offset=offset, prior=prior)
        M, D, K = refinement.mass, refinement.damping, refinement.stiffness
    progress.stage("assessing")
    matrices = [np.array(X) for X in scaling.matrices_out(*jax.device_get((M, D, K)))]
    for matrix, name in zip(matrices, ("mass", "damping", "stiffness")):
        for (owner, r, c), value in entries.items():
            if owner == name:
                matrix[r, c] = matrix[c, r] = value
    model = MechanicalModel(
        *matrices,
        drive=drive,
        measured=records[0].measured,
        input_names=records[0].input_names,
        output_names=records[0].output_names,
        input_units=records[0].input_units,
        output_units=records[0].output_units,
    )
    result = assess(
        model,
        records,
        held_out,
        setting,
        scaling,
        signals,
        batch,
        form,
        held,
        start,
        refinement,
        tuple(notes),
    )
    return result if records is whole else result.judged_on(whole)


def _preflight(records: list[Record]) -> list[str]:
    """Findings on the raw record, as notes; those that leave nothing to identify are raised."""
    notes = []
    for record in records:
        for finding in preflight(record, relations=False):
            if finding.effect == "identical_outputs":
                raise ComputationError(
                    RESULTS.singular_state_basis, stage="raw record", detail=finding.message.rstrip(".")
                )
            notes.append(finding.message)
    return notes


def _grid(values, default, name: str) -> np.ndarray:
    if values is None:
        return np.asarray(default)
    grid = np.unique(np.atleast_1d(np.asarray(values, dtype=float)))
    if grid.size == 0 or not np.all(np.isfinite(grid)) or np.any(grid <= 0):
        raise ValueError(f"{name}={values} must be positive; give one number or several.")
    return grid


def _start_options(
    records, time_constants, block_rows, weight, map, input_matrix_from, known_mass, mass, *, thorough
) -> StartOptions:
    """What the start is looked for with, checked against the records."""
    longest = max(records, key=lambda r: r.samples)
    taus = _grid(time_constants, default_time_constants(longest), "time_constants")
    rows = _grid(block_rows, usable_block_rows(longest), "block_rows")
    if np.any(rows != np.round(rows)) or np.any(rows < 3):
        raise ValueError(f"block_rows={block_rows} must be whole numbers of at least 3.")
    rows = tuple(int(i) for i in rows)
    columns = 2 * max(rows) * (longest.inputs + longest.outputs + 1)
    if longest.samples <= columns:
        raise ComputationError(
            RESULTS.too_short,
            stage="subspace start",
            detail=f"{longest.samples} samples for {max(rows)} block rows, which need more than {columns}",
        )
    known_mass = known_mass if np.all(np.isfinite(known_mass)) else None
    return StartOptions(taus, rows, weight, map, input_matrix_from, known_mass, thorough, mass)


def heavier(M, D, K) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Scaled M, D, K with so much more mass that no mode is faster than what samples show; None where none is."""
    rates, shapes = scipy.linalg.eigh(K, M + 1e-12 * np.trace(M) * np.eye(len(M)))
    fast = rates > FASTEST**2
    if not np.any(fast):
        return None
    moved = M @ shapes[:, fast] * np.sqrt(rates[fast] / SHOWN**2 - 1.0)
    return M + moved @ moved.T, D, K


def _best_refined(
    starts: list[Start], others, refined, setting: Setting, signals: list[Signals], progress: AbstractProgress
):
    """The start whose refinement simulates best, and that refinement.

    A start that serves is refined alone, and the others too where that does not settle or ends at a mass that is next
    to singular; where inertia hardly shows, it is tried with more mass as well. From poor starts a refinement may end
    in another minimum, so that the best few are refined, until one end is near the record.
    """
    best = failure = None
    left_over = list(starts)
    for k in range(MOST_STARTS):
        if not left_over:
            break
        start = left_over.pop(0)
        progress.stage("refining" if k == 0 else f"refining from another start ({k + 1})")
        try:
            end = refined(start)
        except ComputationError as error:
            failure = failure or error
            continue
        masses, slower = np.linalg.eigvalsh(end.mass), heavier(end.mass, end.damping, end.stiffness)
        settled = end.result == RESULTS.successful and masses[0] > SLIGHT * masses[-1]
        if slower is not None and k == 0:
            left_over.insert(0, replace(start, matrices=slower))
        if k == 0 and len(starts) == 1:
            if settled and slower is None:
                return start, end
            left_over += others()
        left = total_deviation((end.mass, end.damping, end.stiffness), setting, signals)
        reached = float(score(left))
        if slower is not None:
            # A mode that samples do not show may be the alias of one that they do.
            reached -= FAST_PRICE / (2 * sum(s.samples for s in signals))
        if best is None or reached > best[0]:
            best = reached, start, end
        if settled and slower is None and np.all(left < NEAR):
            break
    if best is None:
        raise failure
    return best[1:]
