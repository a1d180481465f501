"""A linear model with more freedom than M, D, K, fitted to the same record: free residues at free poles.

Every output is a sum over modes, each a second-order section with numerators of its own for every input,

    y_k = Σ_j Σ_i (r1 z⁻¹ + r2 z⁻²)/(1 − a1 z⁻¹ − a2 z⁻²) u_i + free motion + offset,

linear but for two numbers a mode. M, D, K of as many coordinates is contained in it; symmetry, one shape a mode and
the input map are what the residues are freed of.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from ...numerics.responses.filters import filtered

LEAST = 1e-14
"""Smallest ω² and damping rate of a mode, time in samples."""

STEPS = 10
"""Most Gauss-Newton steps of the poles."""

SETTLED = 0.3
"""Decrease of −2 ln L by one more step below which the poles have settled: what follows decides nothing."""

RANK = 1e-11
"""Eigenvalue of the features' Gram matrix, relative to the largest, below which a direction is dependent."""

CELLS = 40
DAMPING_RATIO = 0.1
"""The grid from which one more mode starts: frequencies, and the damping that lets neighbours overlap."""


@dataclass(frozen=True)
class Whitened:
    """The record as a whitening filter leaves it, per output.

    `y`: divided by the standard deviation of the noise; `drives`: per output the inputs and a unit impulse at the
    first sample, through the same filter; `level`: a constant likewise; `kept`: 1 where a sample counts; `alike`:
    whether one table of features serves all outputs; `direct`: whether inputs reach outputs at once.
    """

    y: Float[np.ndarray, "outputs samples"]
    drives: list[Float[np.ndarray, "signals samples"]]
    level: list[Float[np.ndarray, " samples"]]
    kept: Float[np.ndarray, "outputs samples"]
    alike: bool
    direct: bool

    @classmethod
    def of(
        cls,
        y: Float[np.ndarray, "samples outputs"],
        u: Float[np.ndarray, "samples inputs"],
        coefficients: list[Float[np.ndarray, " order"]],
        size: Float[np.ndarray, " outputs"],
        *,
        direct: bool,
    ) -> "Whitened":
        """Filter a record.

        **Arguments:** `y`: missing samples NaN; `u`; `coefficients`: 1, −a_1, … per output; `size`: standard deviation
        of each output's innovations; `direct`.
        """
        filled = np.nan_to_num(y - np.nanmean(y, axis=0)).T
        kept = np.isfinite(y).T.astype(float)
        impulse = np.eye(1, len(u))
        drives = np.concatenate([(u - u.mean(axis=0)).T, impulse])
        alike = all(len(c) == 1 for c in coefficients) and bool(np.all(kept == kept[:1]))
        return cls(
            np.stack([filtered(c, [1.0], row) / s for c, row, s in zip(coefficients, filled, size)]) * kept,
            [drives if len(c) == 1 else filtered(c, [1.0], drives) for c in coefficients],
            [filtered(c, [1.0], np.ones(len(u))) for c in coefficients],
            kept,
            alike,
            direct,
        )

    @property
    def count(self) -> float:
        """Output samples that count."""
        return float(np.sum(self.kept))


@dataclass(frozen=True)
class RivalFit:
    """A fitted rival.

    `poles`: ln c0, ln c1 of s² + c1 s + c0 per mode, time in samples; `residual`, whitened; `cost`: its sum of
    squares; `parameters`: how many were free; `tables` and `bases`: features of every output and what makes them
    orthonormal; `motions`: what every mode contributes; `solutions`: coefficients of the features; `sizes`: what
    these were divided by.
    """

    poles: Float[np.ndarray, "modes 2"]
    residual: Float[np.ndarray, "outputs samples"]
    cost: float
    parameters: int
    tables: list[Float[np.ndarray, "features samples"]]
    bases: list[Float[np.ndarray, "rank features"]]
    motions: Float[np.ndarray, "outputs modes samples"]
    solutions: list[Float[np.ndarray, " features"]]
    sizes: list[Float[np.ndarray, " features"]]

    def off(self, k: int, rows: Float[np.ndarray, "rows samples"]) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrix of rows off the features of output k, and their products with the residual."""
        across = self.bases[k] @ (self.tables[k] @ rows.T)
        return rows @ rows.T - across.T @ across, rows @ self.residual[k]

    def response(self, mode: int, omega: float, data: Whitened) -> Complex[np.ndarray, "outputs inputs"]:
        """Frequency response of one mode at `omega` [rad/sample]."""
        z = np.exp(1j * omega)
        a1, a2 = sections(self.poles[mode : mode + 1])[0]
        count = len(data.drives[0])
        rows = []
        for solution, sizes in zip(self.solutions, self.sizes):
            own = slice(2 * mode * count, 2 * (mode + 1) * count)
            first, difference = (solution[own] / sizes[own]).reshape(2, count)[:, :-1]
            rows.append((first / z + difference * (1 / z - 1 / z**2)) / (1 - a1 / z - a2 / z**2))
        return np.array(rows)


def poles_of(A: Float[np.ndarray, "states states"]) -> Float[np.ndarray, "modes 2"]:
    """Poles, as `RivalFit` has them, of a continuous system matrix with time in samples."""
    values = np.linalg.eigvals(A)
    pairs = [(abs(s) ** 2, -2 * s.real) for s in values[values.imag > 0]]
    real = np.sort(values[values.imag == 0].real)
    half = len(real) // 2
    pairs += [(a * b, -(a + b)) for a, b in zip(real[:half], real[half:][::-1])]
    return np.log(np.maximum(np.array(pairs).reshape(-1, 2), LEAST))


def sections(poles: Float[np.ndarray, "modes 2"]) -> Float[np.ndarray, "modes 2"]:
    """a1, a2 of the sampled modes."""
    c0, c1 = np.exp(poles).T
    inside = c0 - c1**2 / 4
    root = np.sqrt(np.abs(inside))
    turn = np.where(inside >= 0, np.cos(root), np.cosh(np.minimum(root, 300.0)))
    return np.stack([2 * np.exp(-c1 / 2) * turn, -np.exp(-c1)], axis=1)


def _late(x: np.ndarray) -> np.ndarray:
    """One sample later, at rest before."""
    return np.concatenate([np.zeros_like(x[..., :1]), x[..., :-1]], axis=-1)


def _table(poles, data: Whitened, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Features of one output and what they were divided by: motions of every mode, offset, inputs that act at once."""
    drives = data.drives[k]
    rows = []
    for a1, a2 in sections(poles):
        x = filtered([1.0], [1.0, -a1, -a2], drives)
        before = _late(x)
        # Inputs act one sample later, the impulse that stands for the first state at once. A difference in place of
        # the second delay: slow modes hardly change in a sample.
        x[:-1] = before[:-1]
        rows += [x, x - np.concatenate([_late(before[:-1]), before[-1:]])]
    rows.append(data.level[k][None])
    if data.direct:
        rows.append(drives[:-1])
    table = np.concatenate(rows) * data.kept[k]
    size = np.linalg.norm(table, axis=1)
    size = np.where(size > 0, size, 1.0)
    return table / size[:, None], size


def at_poles(poles, data: Whitened) -> RivalFit:
    """Residues by least squares at given poles."""
    modes = len(poles)
    tables, bases, solutions, sizes = [], [], [], []
    residual = np.empty_like(data.y)
    motions = np.zeros((len(data.y), modes, data.y.shape[1]))
    count = poles.size
    for k, target in enumerate(data.y):
        if k and data.alike:
            table, basis, size = tables[0], bases[0], sizes[0]
        else:
            table, size = _table(poles, data, k)
            values, vectors = np.linalg.eigh(table @ table.T)
            good = values > RANK * values[-1]
            basis = (vectors[:, good] / np.sqrt(values[good])).T
        solution = basis.T @ (basis @ (table @ target))
        rest = target - solution @ table
        # Once more: the Gram matrix has the square of the table's condition.
        again = basis.T @ (basis @ (table @ rest))
        residual[k] = rest - again @ table
        solution = solution + again
        width = 2 * len(data.drives[k])
        for j in range(modes):
            motions[k, j] = solution[j * width : (j + 1) * width] @ table[j * width : (j + 1) * width]
        tables.append(table)
        bases.append(basis)
        solutions.append(solution)
        sizes.append(size)
        count += len(basis)
    return RivalFit(poles, residual, float(np.sum(residual**2)), count, tables, bases, motions, solutions, sizes)


def no_modes(data: Whitened) -> RivalFit:
    """What offsets alone leave, to add modes to."""
    return at_poles(np.zeros((0, 2)), data)


def _pole_equations(fit: RivalFit, data: Whitened) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and right-hand side of the poles, residues projected out."""
    step = 1e-6
    slopes = np.stack(
        [(sections(fit.poles + step * e) - sections(fit.poles - step * e)) / (2 * step) for e in np.eye(2)], axis=2
    )
    gram, slope = 0.0, 0.0
    for k, motion in enumerate(fit.motions):
        rows = []
        for j, (a1, a2) in enumerate(sections(fit.poles)):
            # The derivative of N/A u by a1 is z⁻¹/A times N/A u itself.
            first = filtered([0.0, 1.0], [1.0, -a1, -a2], motion[j])
            rows.append(slopes[j].T @ np.stack([first, _late(first)]))
        part, product = fit.off(k, np.concatenate(rows) * data.kept[k])
        gram, slope = gram + part, slope + product
    return gram, slope


def fit_rival(poles: Float[np.ndarray, "modes 2"], data: Whitened, *, steps: int = STEPS) -> RivalFit:
    """Poles and residues by least squares, from given poles.

    **Arguments:** `poles`; `data`; `steps`: most steps of the poles.

    **Returns:** a `RivalFit`.

    **Reference:** Kaufman, BIT 15 (1975) 49-57 (variable projection), with Marquardt's damping.
    """
    here = at_poles(poles, data)
    damping = 1e-3
    for _ in range(steps):
        gram, slope = _pole_equations(here, data)
        variance = max(here.cost / max(data.count - here.parameters, 1.0), 1e-300)
        size = np.maximum(np.diag(gram), 1e-12 * np.max(np.diag(gram)))
        better = None
        while damping < 1e6 and np.all(size > 0):
            step = np.linalg.solve(gram + damping * np.diag(size), slope)
            if not float(slope @ step) > SETTLED * variance:
                break
            moved = here.poles + np.clip(step, -1.0, 1.0).reshape(-1, 2)
            trial = at_poles(np.clip(moved, np.log(LEAST), [2 * np.log(np.pi), np.log(20.0)]), data)
            if trial.cost < here.cost:
                better = trial
                damping = max(damping / 10, 1e-9)
                break
            damping *= 10
        if better is None:
            break
        here = better
    return here


def further_modes(fit: RivalFit, data: Whitened, *, keep: int = 2) -> Float[np.ndarray, "starts 2"]:
    """Poles of one more mode that would explain most of a rival's residual, by a grid over frequency.

    **Arguments:** `fit`; `data`; `keep`: how many, no two of them neighbours.

    **Returns:** the poles, best first.
    """
    grid = np.geomspace(min(4 * np.pi / data.y.shape[1], 0.1), 0.8 * np.pi, CELLS)
    poles = np.log(np.stack([grid**2, 2 * DAMPING_RATIO * grid], axis=1))
    gains = np.zeros(CELLS)
    for c, (a1, a2) in enumerate(sections(poles)):
        for k in range(len(data.y)):
            if k == 0 or not data.alike:
                x = filtered([0.0, 1.0], [1.0, -a1, -a2], data.drives[k][:-1])
                x = np.concatenate([x, x - _late(x)]) * data.kept[k]
                x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
                gram, _ = fit.off(k, x)
                values, vectors = np.linalg.eigh(gram)
                good = values > 1e-7
            along = vectors[:, good].T @ (x @ fit.residual[k])
            gains[c] += np.sum(along**2 / values[good])
    chosen: list[int] = []
    for c in np.argsort(-gains):
        if all(abs(c - other) > 2 for other in chosen):
            chosen.append(int(c))
        if len(chosen) == keep:
            break
    return poles[chosen]
