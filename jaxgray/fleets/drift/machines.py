"""Machines over time: a reference for each, local statistics of its records, and what has changed since when."""

from dataclasses import dataclass, field

import numpy as np
import scipy.stats
from jaxtyping import Float

from ...diagnosis.words.titles import title_of
from ...numerics.matrices.linear_algebra import triangle
from ..population import discoveries
from .changes import FEWEST, Change, change_of, conditions, shapes_of

RATE = 0.05
"""Expected share of false ones among the alarms, over all machines and parameters."""

SIGNIFICANT = 0.01
"""Probability, over all causes and beginnings, under which a machine that has changed has one more change."""

LOOK_ALIKE = 6.0
"""Twice the logarithm of a likelihood ratio up to which another cause explains as much."""

MOST = 3
"""Changes of one machine that are told at most."""

HUBER = 2.0
"""Standard deviations from which a record counts less for the reference."""


@dataclass(frozen=True)
class Machine:
    """The records of one machine in the order of time.

    `name`; `files`; `when`: as text; `covariates`; `references`: mass, damping, stiffness at the conditions of every
    record; `noise`: standard deviation per output; `outputs`: their names.
    """

    name: str
    files: tuple[str, ...]
    when: tuple[str, ...]
    covariates: Float[np.ndarray, "records covariates"]
    references: tuple[dict, ...]
    noise: tuple[float, ...]
    outputs: tuple[str, ...]

    def only(self, records: list[int]) -> "Machine":
        """The same with some of its records."""
        files, when, references = ([part[k] for k in records] for part in (self.files, self.when, self.references))
        kept = tuple(files), tuple(when), self.covariates[records], tuple(references)
        return Machine(self.name, *kept, self.noise, self.outputs)


@dataclass(frozen=True)
class Drift:
    """One change of a machine.

    `machine`; `name`: of the parameter, "stiffness[0,0]", or effect and place, "coulomb_friction y1"; `title` in
    words; `change`; `since`: file of its first record, `when` as text; `relative`: size by the reference's value, None
    for effects; `probability`: of the test with all other parameters as nuisances; `alternatives`: names that explain
    as much; `sentence`; `estimates` over the records with their `errors`, all entries of M, D, K free in each.
    """

    machine: str
    name: str
    title: str
    change: Change
    since: str
    when: str
    relative: float | None
    probability: float
    alternatives: tuple[str, ...]
    sentence: str
    estimates: Float[np.ndarray, " records"] = field(repr=False)
    errors: Float[np.ndarray, " records"] = field(repr=False)


def machines_of(rows: list[dict], results: list[dict | None], covariates: tuple[str, ...]):
    """Machines whose records can be compared, and why others cannot.

    **Arguments:** `rows` of the table; `results` of the same records; `covariates`: names of columns.

    **Returns:** machines, and reasons by the names of the others.
    """
    groups: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        if row["machine"] is not None and row["outcome"] != "failed":
            groups.setdefault(row["machine"], []).append(k)
    usual = _usual_channels(results)
    machines, left = [], {}
    for name, members in sorted(groups.items()):
        odd = next((why for why in (_beyond(results[k]) for k in members) if why), None)
        if odd is not None:
            left[name] = odd
            continue
        members.sort(key=lambda k: (_time(rows[k]), rows[k]["file"]))
        members = [k for k in members if _channels(results[k]) == usual]
        if len(members) < FEWEST:
            left[name] = f"{len(members)} records that can be used; changes are looked for from {FEWEST}"
            continue
        machines.append(_machine(name, [rows[k] for k in members], [results[k] for k in members], covariates))
    return machines, left


def _beyond(result: dict) -> str | None:
    """Why a model is of a kind whose parameters are not followed; None where they are."""
    model = _model(result)
    if model.get("base") is not None:
        return "base excitation leaves the scale of the masses open"
    if model.get("hidden"):
        return "coordinates that no output measures are not followed"
    return None


def _time(row: dict) -> tuple:
    number = row["when_number"]
    return (0, number) if number is not None else (1, row["when"] or row["file"])


def _model(result: dict) -> dict:
    document = result["document"]
    return (document.get("baseline") or document)["model"]


def _channels(result: dict | None):
    if result is None or result["document"] is None:
        return None
    model = _model(result)
    return tuple(model["output_names"]), tuple(model["input_names"])


def _usual_channels(results):
    seen = [channels for channels in map(_channels, results) if channels is not None]
    return max(set(seen), key=seen.count) if seen else None


def _machine(name: str, rows: list[dict], results: list[dict], covariates: tuple[str, ...]) -> Machine:
    """A machine with its reference: M, D, K over the covariates, records that stand out counting less."""
    conditions_of = np.array([[row[c] for c in covariates] for row in rows], dtype=float).reshape(len(rows), -1)
    models = [_model(result) for result in results]
    theta = np.array([_entries(model) for model in models])
    Z = conditions(conditions_of)
    smooth = np.stack([_fitted(Z, x) for x in theta.T], axis=1)
    n = len(models[0]["mass"])
    floors = [(result["document"].get("baseline") or result["document"])["noise_floor"] for result in results]
    noise = np.median([[floor[o] for o in models[0]["output_names"]] for floor in floors], axis=0)
    return Machine(
        name,
        tuple(row["file"] for row in rows),
        tuple(row["when"] or "" for row in rows),
        conditions_of,
        tuple(_matrices(x, n) for x in smooth),
        tuple(float(f"{v:.6g}") for v in noise),
        tuple(models[0]["output_names"]),
    )


def _entries(model: dict) -> np.ndarray:
    r, c = triangle(len(model["mass"]))
    return np.concatenate([np.array(model[name])[r, c] for name in ("mass", "damping", "stiffness")])


def _matrices(entries: np.ndarray, n: int) -> dict:
    """Matrices as lists, rounded: the key of a score must not hang on the last digit."""
    r, c = triangle(n)
    made = {}
    for name, part in zip(("mass", "damping", "stiffness"), np.split(entries, 3)):
        X = np.zeros((n, n))
        X[r, c] = X[c, r] = [float(f"{v:.7g}") for v in part]
        made[name] = X.tolist()
    return made


def _fitted(Z: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A series by the conditions, by Huber's weights."""
    weights = np.ones(len(x))
    for _ in range(20):
        beta = np.linalg.lstsq(Z * weights[:, None], x * weights, rcond=None)[0]
        r = x - Z @ beta
        scale = 1.4826 * np.median(np.abs(r - np.median(r)))
        weights = np.sqrt(1 / np.maximum(np.abs(r) / max(HUBER * scale, 1e-300), 1.0))
    return Z @ beta


class _Statistics:
    """Scores and informations of the records of a machine, for what all of them have."""

    def __init__(self, documents: list[dict]):
        shared = [name for name in documents[0]["names"] if all(name in d["names"] for d in documents)]
        self.entries = documents[0]["entries"]
        self.names, s, F = shared, [], []
        for document in documents:
            at = [document["names"].index(name) for name in shared]
            s.append(np.array(document["score"])[at])
            F.append(np.array(document["information"])[np.ix_(at, at)])
        self.s, self.F = np.array(s), np.array(F)

    def series(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Estimate of one parameter per record with all entries of M, D, K as nuisances, and its standard error."""
        others = [k for k in range(self.entries) if k != j]
        A, c = self.F[:, others][:, :, others], self.F[:, others, j]
        weights = np.linalg.solve(A, c[:, :, None])[:, :, 0]
        own = self.F[:, j, j] - np.einsum("rk,rk->r", weights, c)
        target = self.s[:, j] - np.einsum("rk,rk->r", weights, self.s[:, others])
        own = np.maximum(own, 1e-12 * np.maximum(self.F[:, j, j], 1e-300))
        return target / own, 1 / np.sqrt(own)

    def gains(self, j: int, Z: np.ndarray, curves: np.ndarray, known: list[tuple[int, np.ndarray]]) -> np.ndarray:
        """By how much −2 ln likelihood falls where parameter `j` follows each of some curves.

        Constants and covariates of all entries, of `j`, and of what is `known` to have changed are free, and so are the
        sizes of these changes.
        """
        free = [(k, z) for k in dict.fromkeys([*range(self.entries), j, *(k for k, _ in known)]) for z in Z.T]
        free += known
        places, over = [k for k, _ in free], np.array([z for _, z in free])
        F = self.F[:, places][:, :, places]
        N = np.einsum("ar,rab,br->ab", over, F, over)
        b = np.einsum("ar,ra->a", over, self.s[:, places])
        c = np.einsum("ar,ra,gr->ga", over, self.F[:, places, j], curves)
        own = np.einsum("gr,r->g", curves**2, self.F[:, j, j])
        scale = 1 / np.sqrt(np.maximum(np.diag(N), 1e-300))
        inverse = np.linalg.pinv(N * scale[:, None] * scale, rcond=1e-11, hermitian=True) * scale[:, None] * scale
        rest = own - np.einsum("ga,ab,gb->g", c, inverse, c)
        target = curves @ self.s[:, j] - c @ inverse @ b
        return np.where(rest > 1e-6 * own, target**2 / np.maximum(rest, 1e-300), 0.0)


def drifts_of(machines: list[Machine], documents: list[list[dict]]) -> list[Drift]:
    """What has changed in which machine, over all of them together.

    **Arguments:** `machines`; `documents`: of the scores of their records, in order.

    **Returns:** changes, those of one machine in the order of their evidence.
    """
    tests, statistics = [], []
    for m, (machine, scores) in enumerate(zip(machines, documents)):
        known = _Statistics(scores)
        statistics.append(known)
        Z = conditions(machine.covariates)
        for j in range(len(known.names)):
            x, error = known.series(j)
            change = change_of(x, shapes_of(Z, _common(1 / error)))
            if change is not None:
                tests.append((m, j, change))
    if not tests:
        return []
    kept = discoveries(np.array([change.probability for _, _, change in tests]), RATE)
    found = []
    for m, machine in enumerate(machines):
        alarms = {j: change for (i, j, change), keep in zip(tests, kept) if keep and i == m}
        every = {j: change for i, j, change in tests if i == m}
        if alarms:
            found += _named(machine, statistics[m], alarms, every, len(machines))
    return found


def _common(weights: np.ndarray) -> np.ndarray:
    """Weights of the records; equal ones where they hardly differ, so that machines share their thresholds."""
    return np.ones(len(weights)) if np.std(weights) < 0.15 * np.mean(weights) else weights


def _named(machine: Machine, known: _Statistics, alarms: dict, every: dict, machines: int) -> list[Drift]:
    """The causes of a machine's alarms: one after the other what explains most of all its records.

    A cause must be significant by itself, over all causes and beginnings, the first one over all machines, too: one
    change raises several alarms, and so many would admit false ones elsewhere.
    """
    Z = conditions(machine.covariates)
    shapes = shapes_of(Z, np.ones(len(Z)))
    curves = np.array([shapes.curve(k) for k in range(len(shapes.kinds))])
    factor = _dispersion(known, Z)
    found, taken = [], []
    while len(found) < MOST:
        gains = np.array([known.gains(j, Z, curves, taken) for j in range(len(known.names))]) / factor
        best = gains.max(axis=1)
        j = int(np.argmax(best))
        chance = scipy.stats.chi2.sf(best[j], 1) * gains.size
        if chance > (SIGNIFICANT if found else RATE / machines):
            break
        k = int(np.argmax(gains[j]))
        kind, begins = shapes.kinds[k], int(shapes.begins[k])
        alike = tuple(
            known.names[i] for i in np.argsort(-best) if i != j and best[i] > best[j] - LOOK_ALIKE and best[i] > 0
        )
        change = _sized(known, j, Z, curves, shapes, k, gains[j], factor, taken)
        probability = min(alarms[j].probability if j in alarms else every[j].probability, 1.0)
        found.append(_drift(machine, known, j, change, kind, begins, alike, probability))
        taken.append((j, curves[k]))
    return found


def _dispersion(known: _Statistics, Z: np.ndarray) -> float:
    """By how much the estimates of entries spread more than their errors say, records that stand out aside."""
    ratios = []
    for j in range(known.entries):
        x, error = known.series(j)
        step = np.diff(x - Z @ np.linalg.lstsq(Z, x, rcond=None)[0]) / np.sqrt(error[1:] ** 2 + error[:-1] ** 2)
        ratios.append((1.4826 * np.median(np.abs(step))) ** 2)
    return max(float(np.median(ratios)), 1.0)


def _sized(known: _Statistics, j, Z, curves, shapes, k, gains, factor, taken) -> Change:
    """Size and beginning of a change by all records together."""
    x, error = known.series(j)
    others = [curve for i, curve in taken if i == j]
    columns = np.column_stack([Z, *others, curves[k]]) / error[:, None]
    inverse = np.linalg.pinv(columns.T @ columns)
    beta = inverse @ (columns.T @ (x / error))
    end = curves[k][-1]
    alike = [
        b
        for b, kind, g in zip(shapes.begins, shapes.kinds, gains)
        if kind == shapes.kinds[k] and g >= gains[k] - 2 * 1.92
    ]
    level = np.sqrt(factor * inverse[0, 0])
    return Change(
        shapes.kinds[k],
        int(shapes.begins[k]),
        (int(min(alike)), int(max(alike))),
        float(beta[-1] * end),
        float(np.sqrt(factor * inverse[-1, -1]) * end),
        float(gains[k] / 2),
        float("nan"),
        (float(beta[0]), float(level)),
    )


def _drift(machine: Machine, known: _Statistics, j, change: Change, kind, begins, alike, probability) -> Drift:
    name, relative = known.names[j], None
    if j < known.entries:
        matrix, place = name.split("[")
        r, c = (int(k) for k in place.rstrip("]").split(","))
        value = float(np.median([reference[matrix][r][c] for reference in machine.references]))
        relative = change.size / value if value else None
        title = f"{matrix} {machine.outputs[r]}" + ("" if r == c else f" {machine.outputs[c]}")
        verb = ("rises" if change.size > 0 else "falls") + ("" if kind == "step" else " gradually")
    else:
        effect, _, place = name.partition(" ")
        title = title_of(effect, place)
        level, error = change.before
        fresh = abs(level) < 3 * error
        verb = ("begins" if fresh else "grows" if change.size > 0 else "falls") + (
            " at once" if kind == "step" else " and grows" if fresh else ""
        )
    size = f"{change.size:.3g} ± {change.standard_error:.1g}"
    if relative is not None:
        size += f" ({100 * relative:+.2g} %)"
    since = machine.when[begins] or str(begins + 1)
    first, last = change.interval
    sentence = (
        f"{title} of {machine.name} {verb} from record {begins + 1} on ({since}; 95 %: {first + 1} to {last + 1}): "
        f"{size} {'at the last record' if kind == 'ramp' else 'from one record to the next'}."
    )
    x, error = known.series(j)
    return Drift(
        machine.name,
        name,
        title,
        change,
        machine.files[begins],
        since,
        relative,
        probability,
        alike,
        sentence,
        x,
        error,
    )
