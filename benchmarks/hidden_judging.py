"""How one diagnosis compares with the truth that was hidden in its record."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import hidden  # noqa: E402
import hidden_laws as laws  # noqa: E402
import numpy as np  # noqa: E402
from hidden_matrices import matrix_deviations  # noqa: E402

NOT_COMPARED = ("phase", "form")
"""Parameters left out of the count of standard errors: an angle, a word."""


def model_findings(diagnosis):
    """Findings that say what the simulation gets wrong."""
    return [f for f in diagnosis.findings if f.stage == "model"]


def same_place(found, true):
    """Whether a place is the true one; a whole record is every channel of it."""
    return true == "record" or found == true


def explains(finding, effect):
    """Whether the true effect, at its place, is in the class of a finding."""
    return any(m.effect == effect.id and same_place(m.location, effect.place) for m in finding.members)


def deviations(finding, effect):
    """|estimate − truth| in standard errors of every parameter that both have, by name."""
    result = {}
    for name, true in effect.parameters.items():
        if name in NOT_COMPARED or name not in finding.parameters:
            continue
        value = np.atleast_1d(np.asarray(finding.parameters[name].value, dtype=float))
        error = finding.parameters[name].standard_error
        error = np.atleast_1d(np.asarray([np.nan] if error is None else error, dtype=float))
        true = np.atleast_1d(np.asarray(true, dtype=float))
        if len(value) != len(true) or not np.all(np.isfinite(error)) or len(error) != len(value):
            continue
        order = np.arange(len(true))
        for thresholds in ("r", "d"):
            if thresholds in effect.parameters and len(true) > 1:
                order = np.argsort(finding.parameters[thresholds].value)
                true = true[np.argsort(effect.parameters[thresholds])]
        for k, j in enumerate(order):
            key = name if len(true) == 1 else f"{name}{k + 1}"
            result[key] = float(abs(value[j] - true[k]) / max(error[j], 1e-300))
    return result


def matrices(summary):
    """M, D, K of a model as a hidden system."""
    model = summary.model
    return hidden.System(*(np.asarray(X, dtype=float) for X in (model.mass, model.damping, model.stiffness)))


def as_effects(findings):
    """The findings as effects that the independent simulator knows; None where one is unknown to it."""
    effects = []
    for f in findings:
        if f.effect not in laws.KNOWN:
            return None
        values = {name: estimate.value for name, estimate in f.parameters.items()}
        effects.append(
            hidden.Effect(f.effect, f.location, {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()})
        )
    return effects


def true_gain(rng, case, diagnosis, count):
    """Gain in percent over fresh records of the same kind, by the independent simulator; None where it cannot run.

    Mean over `count` records of 100 (RMSE before − after)/RMSE before, RMSE over the outputs in units of the
    diagnosis' noise floor.
    """
    effects = as_effects(model_findings(diagnosis))
    if not effects or diagnosis.extended is None:
        return None
    floor = np.array([diagnosis.noise_floor[f"y{i + 1}"] for i in range(len(case.noise))])
    gains = []
    for _ in range(count):
        u, y, _, p = hidden.fresh(rng, case)

        def rmse(system, terms, u=u, y=y, p=p):
            run = hidden.simulate(system, u, case.sampling_time, terms, hold=case.hold, scheduling=p)
            return np.sqrt(np.nanmean(((y - run) / floor) ** 2))

        before = rmse(matrices(diagnosis.baseline), ())
        after = rmse(matrices(diagnosis.extended), effects)
        gains.append(100 * (before - after) / before)
    return float(np.mean(gains))


def held_out_excess(case, diagnosis):
    """Held-out error of the final model over the true noise, root mean square over the outputs."""
    final = diagnosis.baseline if diagnosis.extended is None else diagnosis.extended
    rmse = np.array([final.rmse["validation"][f"y{i + 1}"] for i in range(len(case.noise))])
    return float(np.sqrt(np.mean((rmse / case.noise) ** 2)))


def only_noise_left(case, diagnosis):
    """Whether the final model errs on held-out data by no more than the noise there, as far as chance goes (three
    standard deviations): what it lacks then, these data do not show."""
    excess, values = held_out_excess(case, diagnosis) ** 2, np.count_nonzero(np.isfinite(case.y_v))
    return bool(excess - 1 < 3 * np.sqrt(2 / values))


def distance_of_rivals(case, diagnosis, truth):
    """By how much, in BIC, the worst of the false members of a class lies behind the truth refitted; None where there
    is no class with one hidden effect in it.

    What the truth would reach refitted from itself is not left to the diagnosis: it is what the noise alone costs, less
    one for every free parameter. Where the best refit ends above that, the difference counts.
    """
    found = model_findings(diagnosis)
    if len(truth) != 1 or len(found) != 1 or len(found[0].members) < 2 or not explains(found[0], truth[0]):
        return None
    members, final = found[0].members, diagnosis.extended
    right = [m.delta_bic for m in members if m.effect == truth[0].id and same_place(m.location, truth[0].place)]
    wrong = [m.delta_bic for m in members if not (m.effect == truth[0].id and same_place(m.location, truth[0].place))]
    n, samples = len(case.noise), len(case.y)
    rmse = np.array([final.rmse["estimation"][f"y{i + 1}"] for i in range(n)])
    noise = np.sqrt(np.nanmean((case.y - case.clean) ** 2, axis=0))
    free = 3 * n * (n + 1) // 2 + 2 * n + len(truth[0].parameters)
    short = max(0.0, float(2 * samples * np.sum(np.log(rmse / noise)) + free))
    return max(max(right) - d for d in wrong) + short if wrong else None


def label(diagnosis, truth):
    """What was said, in a word for the confusion table."""
    found = model_findings(diagnosis)
    if not found:
        return diagnosis.verdict
    words = []
    for f in found:
        names = sorted({m.effect for m in f.members} | {f.effect})
        word = "|".join(names)
        right = [e for e in truth if e.id == f.effect]
        if right and not any(same_place(f.location, e.place) for e in right):
            word += " (place)"
        words.append(word if f.status in ("named", "equivalent") else f"{word} ({f.status})")
    return " + ".join(words) + ("" if diagnosis.verdict in ("named", "equivalent") else f" [{diagnosis.verdict}]")


def judged(rng, case, diagnosis, *, fresh=10):
    """The figures of one record, as a dictionary that JSON can hold."""
    truth = [e for e in case.effects if e.id not in laws.RAW]
    found = model_findings(diagnosis)
    named = [[f for f in found if f.effect == e.id and same_place(f.location, e.place)] for e in truth]
    single = [any(len(f.members) == 1 and f.status == "named" for f in hits) for hits in named]
    in_class = [any(explains(f, e) for f in found) for e in truth]
    extra = [f for f in found if not any(explains(f, e) for e in truth)]
    record_stage = sorted({f.effect for f in diagnosis.findings if f.stage == "record"})
    row = {
        "verdict": diagnosis.verdict,
        "label": label(diagnosis, truth),
        "found": [(f.effect, f.location, f.status) for f in found],
        "found_by": [f.found_by for f in found],
        "record_stage": record_stage,
        "name_and_place": all(single) and bool(truth),
        "in_class": all(in_class) and bool(truth),
        "open": diagnosis.verdict in ("partly", "unexplained"),
        "false_extra": len(extra),
        "class_sizes": [len(f.members) for f in found],
        "rivals_behind": distance_of_rivals(case, diagnosis, truth),
        "held_out_excess": held_out_excess(case, diagnosis),
        "only_noise_left": only_noise_left(case, diagnosis),
        "warnings": list(diagnosis.warnings),
    }
    row["deviations"] = {}
    for e, hits in zip(truth, named):
        for f in hits[:1]:
            row["deviations"] |= {f"{e.id}.{name}": d for name, d in deviations(f, e).items()}
    if row["name_and_place"] and not extra:
        row["matrices"] = matrix_deviations(case, diagnosis)
    # A gain on the data of the fit says nothing of other records: the phase of a disturbance is another one there.
    held_out = diagnosis.gain is not None and diagnosis.gain.held_out
    if row["name_and_place"] and not extra and fresh and held_out:
        gain = true_gain(rng, case, diagnosis, fresh)
        if gain is not None:
            low, high = diagnosis.gain.ci95
            row["gain"] = {"said": diagnosis.gain.percent, "ci95": [low, high], "true": gain}
            row["gain"]["covered"] = bool(low <= gain <= high)
    return row
