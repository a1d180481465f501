"""Records prone to indefinite estimates: short, noisy, hardly damped, hardly seen; what `identify` makes of them.

    python benchmarks/indefinite.py [--records 204] [--first 0] [--json OUT]

Random systems of one to three coordinates, 0 to 20 dB, 100, 200 or 400 samples, of six kinds in turn: plain; damping
of a ten-thousandth; a mode that input and sensors hardly reach; nearly without stiffness; damped above critical; a mode
near the Nyquist frequency. Data come from SciPy (tests/independent.py). Of every result:

- the least eigenvalues of M (above 0), D and K (0 or above, rounding apart);
- everything in it that is not a number, in any field;
- whether it converged or says in a warning that it did not. What it says is checked: from the end of a run that claims
  to have converged, SciPy's least squares over Cholesky factors, first state and offsets goes on downhill in -2 ln L;
  to find more than --slack there is a silent failure.

Records that `identify` refuses with an error of its own are counted by their message.
"""

import argparse
import collections
import dataclasses
import json
import pathlib
import sys
import time
import warnings

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

import jax  # noqa: E402
import numpy as np  # noqa: E402
import scipy.optimize  # noqa: E402

jax.config.update("jax_enable_x64", True)

import independent  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.numerics.outcomes import RESULTS  # noqa: E402

KINDS = ("plain", "hardly damped", "hardly seen", "hardly any stiffness", "overdamped", "near Nyquist")

LENGTHS = (100, 200, 400)
"""Samples, few lengths so that little is compiled."""

ROUNDING = 1e-9
"""Negative eigenvalue relative to the largest that is rounding."""

SAID = ("stopped after", "ended no better", "no better than its start", "not settled")
"""What a warning says of a refinement that did not converge."""


def case(seed):
    """A record, its kind, and the system that made it."""
    rng = np.random.default_rng([90, seed])
    kind, dofs = KINDS[seed % len(KINDS)], int(rng.integers(1, 4))
    M, D, K = independent.random_system(rng, dofs)
    inputs = int(rng.integers(1, dofs + 1))
    E = np.eye(dofs, inputs)
    if kind == "hardly damped":
        D = 1e-4 * D
    if kind == "hardly seen" and dofs > 1:
        # The last coordinate hangs on the others by next to nothing, and no input acts there.
        inputs = min(inputs, dofs - 1)
        E = np.eye(dofs, inputs)
        for X in (M, D, K):
            X[-1, :-1] *= 1e-3
            X[:-1, -1] *= 1e-3
    if kind == "hardly any stiffness":
        K = 1e-3 * K
    if kind == "overdamped":
        D = D + np.diag(rng.uniform(3, 6, dofs) * np.sqrt(np.diag(M) * np.diag(K)))
    fastest = np.sqrt(np.max(np.linalg.eigvals(np.linalg.solve(M, K)).real))
    share = 0.9 if kind == "near Nyquist" else rng.uniform(0.05, 0.4)
    h = share * np.pi / fastest
    samples, decibels = LENGTHS[int(rng.integers(len(LENGTHS)))], float(rng.uniform(0, 20))
    hold = ("zero", "linear")[int(rng.integers(2))]
    measured = ("displacement", "velocity", "acceleration")[int(rng.integers(3))]
    if hold == "zero":
        u = independent.random_steps(rng, samples, inputs, h, (h, 20 * h))
    else:
        u = independent.smooth_noise(rng, samples, inputs, 0.5)
    y = independent.simulate(M, D, K, u, h, E=E, hold=hold, measured=measured)
    y = y + 10 ** (-decibels / 20) * y.std(axis=0) * rng.standard_normal(y.shape)
    about = {"kind": kind, "dofs": dofs, "inputs": inputs, "samples": samples, "decibels": round(decibels, 1)}
    return jaxgray.Record(u, y, h, hold=hold, measured=measured), about | {"hold": hold, "measured": measured}


def not_numbers(value, path="result", seen=None):
    """Paths of all floats and arrays of floats below a value that hold a NaN."""
    seen = set() if seen is None else seen
    if id(value) in seen or isinstance(value, jaxgray.Record):
        return []
    seen.add(id(value))
    if isinstance(value, float | np.ndarray | np.generic | jax.Array):
        X = np.asarray(value)
        return [path] if X.dtype.kind in "fc" and np.any(np.isnan(X)) else []
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = [(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)]
    elif isinstance(value, dict):
        parts = list(value.items())
    elif isinstance(value, list | tuple):
        parts = list(enumerate(value))
    else:
        return []
    return [found for name, part in parts for found in not_numbers(part, f"{path}.{name}", seen)]


def sizes_of(result):
    """What M, D, K would be of the size of, by the mass and the sampling time: one of no damping at all has none."""
    mass, h = np.trace(result.mass), result.records[0].sampling_time
    return mass, mass / h, mass / h**2


def indefinite(result):
    """Matrices that no mechanical system has."""
    found = []
    for name, size in zip(("mass", "damping", "stiffness"), sizes_of(result)):
        X = getattr(result, name)
        values = np.linalg.eigvalsh(X)
        if np.max(np.abs(X - X.T)) > ROUNDING * np.max(np.abs(X)):
            found.append(f"{name} not symmetric")
        least = values[0] if name == "mass" else values[0] + ROUNDING * max(values[-1], 1e-6 * size)
        if least < 0 or (name == "mass" and values[0] <= 0):
            found.append(f"{name} {values[0]:.3g} of {values[-1]:.3g}")
    return found


class Descent:
    """-2 ln L of M, D, K by Cholesky factors, first state and offsets, with the output noise that fits best."""

    def __init__(self, result):
        record = result.records[0]
        self.record, self.dofs = record, result.model.dofs
        self.E = np.asarray(result.model.drive.input_map)
        self.rows = np.tril_indices(self.dofs)
        # Coordinates that hardly move have large entries: each in units of its own mass.
        self.units, h = np.sqrt(np.diag(result.mass)), record.sampling_time
        factors = [self._factor(X, size) for X, size in zip(self._matrices(result), (1.0, 1 / h, 1 / h**2))]
        linear = np.concatenate([L[self.rows] for L in factors])
        self.count = len(linear)
        self.begin = np.concatenate([linear, np.zeros(2 * self.dofs + record.outputs)])
        self.table = None
        # The factors lie a little off an edge on which the result may lie: the cost there is that of the result.
        self.first = self.cost(self._with_best_nuisance(self.begin, self._matrices(result)), self._matrices(result))
        self.begin = self._with_best_nuisance(self.begin)

    def _factor(self, X, size):
        """Of a matrix lifted off the edge, where a factor would not move; `size`: of one of no stiffness at all."""
        values, vectors = np.linalg.eigh(X / np.outer(self.units, self.units))
        least = 1e-9 * max(values[-1], 1e-6 * size)
        lifted = (vectors * np.maximum(values, least)) @ vectors.T
        return np.linalg.cholesky(lifted * np.outer(self.units, self.units))

    @staticmethod
    def _matrices(result):
        return result.mass, result.damping, result.stiffness

    def residual(self, theta, matrices=None):
        M, D, K = self._built(theta) if matrices is None else matrices
        x0, offset = np.split(theta[self.count :], [2 * self.dofs])
        options = {"E": self.E, "hold": self.record.hold, "measured": self.record.measured, "x0": x0}
        return (
            self.record.y - independent.simulate(M, D, K, self.record.u, self.record.sampling_time, **options) - offset
        )

    def _built(self, theta):
        built = []
        for part in np.split(theta[: self.count], 3):
            L = np.zeros((self.dofs, self.dofs))
            L[self.rows] = part
            built.append(L @ L.T)
        return built

    def _with_best_nuisance(self, theta, matrices=None):
        """First state and offsets enter linearly: the best by one least squares, whitened as they leave it."""
        W = np.eye(self.record.outputs)
        for _ in range(3):
            base = self.residual(theta, matrices)
            columns = []
            for k in range(self.count, len(theta)):
                moved = theta.copy()
                moved[k] += 1.0
                columns.append(((base - self.residual(moved, matrices)) @ W).ravel())
            table = np.stack(columns, axis=1)
            size = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
            theta = theta.copy()
            theta[self.count :] += np.linalg.lstsq(table / size, (base @ W).ravel(), rcond=1e-12)[0] / size
            W = self.whitening(self.residual(theta, matrices))
        return theta

    @staticmethod
    def whitening(e):
        return np.linalg.inv(np.linalg.cholesky(e.T @ e / len(e))).T

    def cost(self, theta, matrices=None):
        e = self.residual(theta, matrices)
        return len(e) * np.linalg.slogdet(e.T @ e / len(e))[1]

    def gained(self, passes=3):
        """What going on takes off -2 ln L."""
        best = self.cost(self.begin)
        theta = self.begin
        for _ in range(passes):
            W = self.whitening(self.residual(theta))
            try:
                end = scipy.optimize.least_squares(
                    lambda x, W=W: np.nan_to_num((self.residual(x) @ W).ravel(), nan=1e6, posinf=1e6, neginf=-1e6),
                    theta,
                    x_scale="jac",
                    max_nfev=15,
                )
            except (np.linalg.LinAlgError, ValueError, OverflowError):
                break
            now = self.cost(end.x)
            if not now < best - 1e-3:
                best = min(best, now)
                break
            theta, best = end.x, now
        return self.first - best


def judged(record, about, slack):
    """What `identify` makes of one record."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begun = time.perf_counter()
        try:
            result = jaxgray.identify(record)
        except (ValueError, jaxgray.ComputationError) as error:
            return about | {"outcome": "refused", "why": str(error)}
        about = about | {"seconds": time.perf_counter() - begun}
    told = [text for text in result.warnings if any(words in text for words in SAID)]
    rigid = any("rigid body" in text for text in result.warnings)
    claimed = result.refinement is not None and result.refinement.result == RESULTS.successful
    found = about | {
        "indefinite": indefinite(result),
        "not_numbers": not_numbers(result),
        "noise_of_numerics": sorted({str(one.message) for one in caught if issubclass(one.category, RuntimeWarning)}),
        "outcome": "converged" if claimed else "told" if told else "silent",
        "warnings": list(result.warnings),
        "gained": None,
    }
    if claimed and not rigid:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found["gained"] = float(Descent(result).gained())
        if not found["gained"] <= slack and not told:
            found["outcome"] = "silent"
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=204)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--slack", type=float, default=1.0, help="in -2 ln L")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    rows = []
    for seed in range(arguments.first, arguments.first + arguments.records):
        row = {"seed": seed} | judged(*case(seed), arguments.slack)
        rows.append(row)
        if row["outcome"] == "silent" or row.get("indefinite") or row.get("not_numbers"):
            shown = {name: value for name, value in row.items() if name != "warnings"}
            print(f"   {shown}", flush=True)
        if arguments.json:
            pathlib.Path(arguments.json).write_text(json.dumps(rows, indent=1))
    answered = [row for row in rows if row["outcome"] != "refused"]
    print(f"{len(rows)} records, {len(answered)} answered")
    for kind in KINDS:
        outcomes = collections.Counter(row["outcome"] for row in rows if row["kind"] == kind)
        print(f"   {kind}: " + ", ".join(f"{count} {name}" for name, count in sorted(outcomes.items())))
    for why, count in collections.Counter(row["why"] for row in rows if row["outcome"] == "refused").most_common():
        print(f"   {count} refused: {why}")
    gained = [row["gained"] for row in answered if row["gained"] is not None]
    print(f"indefinite: {sum(bool(row['indefinite']) for row in answered)}")
    print(f"not a number: {sum(bool(row['not_numbers']) for row in answered)}")
    print(f"silent failures to converge: {sum(row['outcome'] == 'silent' for row in answered)}")
    print(f"records with RuntimeWarnings: {sum(bool(row['noise_of_numerics']) for row in answered)}")
    if gained:
        middle, most = np.quantile(gained, [0.5, 0.95])
        spread = f"median {middle:.2g}, 95 % {most:.2g}, largest {max(gained):.2g}"
        print(f"SciPy went on from {len(gained)} ends: {spread} in -2 ln L")


if __name__ == "__main__":
    main()
