"""Least squares over positive semidefinite matrices: exact on the host, and a traceable twin."""

import abc
import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from ..outcomes import RESULTS, ComputationError
from .bounded import bounded
from .linear_algebra import duplication, from_symmetric_vector, project_positive, symmetric_size, symmetric_vector
from .namespace import namespace


class PositiveLeastSquares(eqx.Module):
    """The problem min ½ zᵀ P z + qᵀ z over symmetric blocks X_b ⪰ floor_b·I.

    z stacks the blocks as isometric vectors (`symmetric_vector`); `sizes` are their numbers of rows. Where
    `held`, a variable keeps its value in `values` (host solver only).
    """

    quadratic: Float[Array, "variables variables"]
    linear: Float[Array, " variables"]
    floors: Float[Array, " blocks"]
    sizes: tuple[int, ...] = eqx.field(static=True)
    held: Bool[Array, " variables"] | None = None
    values: Float[Array, " variables"] | None = None

    @classmethod
    def from_residual(
        cls, factor: Float[Array, "rows variables"], target: Float[Array, " rows"], sizes, floors
    ) -> "PositiveLeastSquares":
        """The problem min ½ ‖factor z − target‖² over the same blocks."""
        xp = namespace(factor, target)
        return cls(factor.T @ factor, -(factor.T @ target), xp.asarray(floors, dtype=factor.dtype), tuple(sizes))

    def blocks(self, z: Float[Array, " variables"]) -> tuple[Float[Array, "n n"], ...]:
        """The symmetric matrices that z stands for."""
        ends = np.cumsum([n * (n + 1) // 2 for n in self.sizes])
        return tuple(from_symmetric_vector(part) for part in namespace(z).split(z, ends[:-1]))

    @np.errstate(over="ignore", invalid="ignore")
    def unconstrained(self) -> Float[Array, " variables"]:
        """The minimiser without the cone; no numbers where a variable has no curvature, which may overflow here."""
        xp = namespace(self.quadratic, self.linear)
        scale = xp.sqrt(xp.maximum(xp.diag(self.quadratic), np.finfo(self.quadratic.dtype).tiny))
        scaled = self.quadratic / scale[:, None] / scale[None, :]
        target = -self.linear / scale
        if self.held is not None:
            known = xp.where(self.held, self.values * scale, 0.0)
            free = ~self.held
            target = xp.where(free, target - scaled @ known, known)
            scaled = xp.where(free[:, None] & free[None, :], scaled, xp.diag(1.0 - free))
        try:
            return xp.linalg.solve(scaled, target) / scale
        except np.linalg.LinAlgError:
            return np.full(len(target), np.nan)

    @property
    def unit(self) -> np.ndarray:
        """Square root of every variable's curvature (on the host)."""
        diagonal = np.diag(self.quadratic)
        return np.sqrt(np.maximum(diagonal, max(1e-16 * np.max(diagonal), np.finfo(float).tiny)))

    @property
    def lowest(self) -> np.ndarray:
        """The floors as matrices, stacked as the variables (on the host)."""
        return np.concatenate(
            [floor * (duplication(n).T @ np.eye(n).ravel()) for n, floor in zip(self.sizes, self.floors)]
        )

    def split(self, z: np.ndarray) -> list[np.ndarray]:
        """The parts of the single blocks (on the host)."""
        return np.split(z, np.cumsum([n * (n + 1) // 2 for n in self.sizes])[:-1])

    def on_host(self) -> "PositiveLeastSquares":
        """The same problem in NumPy arrays, for which nothing is compiled."""
        return jax.tree_util.tree_map(np.asarray, self)


class AbstractPositiveSolver(eqx.Module):
    """A way to solve a `PositiveLeastSquares`."""

    @abc.abstractmethod
    def __call__(self, problem: PositiveLeastSquares) -> Float[Array, " variables"]:
        """The minimiser, stacked as in the problem."""


class ClarabelSolver(AbstractPositiveSolver):
    """Interior point on the host; exact, with a certificate. Not traceable.

    **Arguments:** `tolerance`: relative gap and feasibility.

    **Reference:** Goulart & Chen, *Clarabel: An interior-point solver for conic programs*.
    """

    tolerance: float = 1e-10

    def __call__(self, problem: PositiveLeastSquares) -> np.ndarray:
        import clarabel
        import scipy.sparse as sparse

        problem = problem.on_host()
        if not bounded(problem.quadratic, problem.linear):
            raise ComputationError(
                RESULTS.semidefinite_solver, stage="semidefinite fit", detail="the problem is not finite"
            )
        free, floors = problem.unconstrained(), problem.floors
        if np.all(np.isfinite(free)) and inside_cone(free, problem.sizes, floors):
            return free
        # The unknown is the step from the values at hand, every entry in units of its own curvature: the gap that the
        # solver leaves is then small beside what the step is worth, not beside the whole sum of squares.
        P, q, unit = problem.quadratic, problem.linear, problem.unit
        begin = np.zeros(len(q)) if problem.values is None else problem.values
        slope = (q + P @ begin) / unit
        size = np.linalg.norm((free - begin) * unit) if np.all(np.isfinite(free)) else np.linalg.norm(slope)
        size = size if size > 0 else 1.0
        step = size / unit
        edge = begin - problem.lowest
        # A positive factor for a whole block leaves its cone as it is.
        ratio = np.concatenate([np.full(len(part), 1 / np.max(part)) for part in problem.split(step)])
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = self.tolerance
        settings.max_iter = 200
        rows, right = [-np.diag(step * ratio)], [edge * ratio]
        cones = [clarabel.PSDTriangleConeT(n) for n in problem.sizes]
        if problem.held is not None and np.any(problem.held):
            held = problem.held
            rows.append(np.eye(len(q))[held])
            right.append(np.zeros(int(held.sum())))
            cones.append(clarabel.ZeroConeT(int(held.sum())))
        solver = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(P / unit[:, None] / unit[None, :])),
            slope / size,
            sparse.csc_matrix(np.concatenate(rows)),
            np.concatenate(right),
            cones,
            settings,
        )
        solution = solver.solve()
        if str(solution.status) not in _ACCEPTED:
            raise ComputationError(
                RESULTS.semidefinite_solver,
                stage="semidefinite fit",
                detail=f"Clarabel says {solution.status}",
            )
        ends = [_polished(problem, begin + step * np.asarray(solution.x))]
        if problem.values is not None:
            ends.append(_polished(problem, begin))
        return _inside(problem, min(ends, key=lambda end: end[1])[0])


def _inside(problem: PositiveLeastSquares, z: np.ndarray) -> np.ndarray:
    """The nearest point of the cone: Newton steps on the condition of the optimum end a little off it, which may be
    outside. Blocks with held entries stay as they are."""
    held = np.zeros(len(z), bool) if problem.held is None else problem.held
    parts = zip(*(problem.split(x) for x in (z, problem.lowest, held)))
    return np.concatenate(
        [part if fixed.any() else _projection_parts(part - low)[0] + low for part, low, fixed in parts]
    )


def inside_cone(z: np.ndarray, sizes: tuple[int, ...], floors: np.ndarray) -> bool:
    """Whether every block lies above its floor."""
    ends = np.cumsum([n * (n + 1) // 2 for n in sizes])
    for n, floor, part in zip(sizes, floors, np.split(z, ends[:-1])):
        if np.linalg.eigvalsh((duplication(n) @ part).reshape(n, n))[0] < floor:
            return False
    return True


_ACCEPTED = ("Solved", "AlmostSolved", "InsufficientProgress")


def _projection_parts(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projection of one block's isometric vector on the cone, and its derivative."""
    n = symmetric_size(len(X))
    if n == 1:
        return np.maximum(X, 0.0), np.array([[float(X[0] > 0)]])
    basis = duplication(n)
    values, vectors = np.linalg.eigh((basis @ X).reshape(n, n))
    clipped = np.maximum(values, 0.0)
    difference = values[:, None] - values[None, :]
    apart = np.abs(difference) > 1e-14 * np.max(np.abs(values), initial=1e-300)
    slope = np.where(
        apart,
        (clipped[:, None] - clipped[None, :]) / np.where(apart, difference, 1.0),
        (values[:, None] + values[None, :]) > 0,
    )
    rotation = np.kron(vectors, vectors)
    return basis.T @ ((vectors * clipped) @ vectors.T).ravel(), basis.T @ (
        rotation * slope.ravel()
    ) @ rotation.T @ basis


def _polished(problem: PositiveLeastSquares, z: np.ndarray, steps: int = 8) -> tuple[np.ndarray, float]:
    """Newton steps on the fixed-point condition of the optimum, each kept only where it helps.

    An interior-point method leaves an error of the square root of its gap; from there the semismooth Newton
    method is quadratic. Returns the point and how far it is from meeting the condition.
    """
    P, q, shift = problem.quadratic, problem.linear, problem.lowest
    # The condition holds for any positive length of the gradient step, one for every block.
    curvature = problem.unit**2
    length = np.concatenate([np.full(len(part), 1 / np.max(part)) for part in problem.split(curvature)])
    P, q = length[:, None] * P, length * q
    held = np.zeros(len(q), bool) if problem.held is None else problem.held
    pick = np.eye(len(q))[held]
    given = np.zeros(0) if problem.held is None else problem.values[held]
    multiplier = -pick @ (P @ z + q)

    def condition(z, multiplier):
        target = z - (P @ z + q) - pick.T @ multiplier - shift
        parts = [_projection_parts(part) for part in problem.split(target)]
        projected = np.concatenate([part for part, _ in parts]) + shift
        value = np.concatenate([z - projected, pick @ z - given])
        slope = scipy.linalg.block_diag(*[derivative for _, derivative in parts])
        return value, slope

    value, slope = condition(z, multiplier)
    for _ in range(steps):
        jacobian = np.block(
            [
                [np.eye(len(z)) - slope @ (np.eye(len(z)) - P), slope @ pick.T],
                [pick, np.zeros((len(pick),) * 2)],
            ]
        )
        move = np.linalg.lstsq(jacobian, -value, rcond=1e-14)[0]
        trial = z + move[: len(z)], multiplier + move[len(z) :]
        found, found_slope = condition(*trial)
        if not np.linalg.norm(found) < np.linalg.norm(value):
            break
        (z, multiplier), value, slope = trial, found, found_slope
    return z, float(np.linalg.norm(value * np.append(problem.unit, np.ones(len(pick)))))


class FreeSolver(AbstractPositiveSolver):
    """The minimiser without the cone; the answer only where that lies inside, which is for the caller to see."""

    def __call__(self, problem: PositiveLeastSquares) -> Float[Array, " variables"]:
        return problem.unconstrained()


class NearestSolver(AbstractPositiveSolver):
    """The minimiser without the cone, every block moved to the nearest matrix in it: closed form, traceable.

    The optimum where that lies inside; elsewhere a start, not an answer.
    """

    def __call__(self, problem: PositiveLeastSquares) -> Float[Array, " variables"]:
        return _project(problem.unconstrained(), problem)


class ProjectedGradientSolver(AbstractPositiveSolver):
    """Accelerated projected gradient, ended by Newton steps; traceable, with implicit derivatives. Not a number where
    the problem is not finite.

    **Arguments:** `tolerance`: norm of the optimality condition, relative; `max_steps`.

    **Reference:** Blondel et al., *Efficient and modular implicit differentiation*.
    """

    tolerance: float = 1e-9
    max_steps: int = 20000

    def __call__(self, problem: PositiveLeastSquares) -> Float[Array, " variables"]:
        curvature = jax.lax.stop_gradient(jnp.linalg.norm(problem.quadratic, ord=2))
        free = jax.lax.stop_gradient(problem.unconstrained())
        size = jnp.sqrt(jnp.mean(free**2))
        size = jnp.where(jnp.isfinite(size) & (size > 0), size, 1.0)
        scaled = PositiveLeastSquares(
            problem.quadratic / curvature,
            problem.linear / (curvature * size),
            problem.floors / size,
            problem.sizes,
        )
        start = jnp.where(jnp.isfinite(free), free, 0.0) / size
        # Projected on the cone, an infinite gradient ends at the floors and looks like an answer.
        finite = jnp.all(jnp.isfinite(problem.quadratic)) & jnp.all(jnp.isfinite(problem.linear))
        return jnp.where(finite, size * _projected_gradient(self, scaled, start), jnp.nan)


_NEWTON_STEPS = 3


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _projected_gradient(solver: ProjectedGradientSolver, problem: PositiveLeastSquares, start):
    jaxopt = _jaxopt()
    loop = jaxopt.ProjectedGradient(
        _objective,
        _project,
        stepsize=1.0,
        maxiter=solver.max_steps,
        tol=solver.tolerance,
        implicit_diff=False,
        jit=True,
        unroll=False,
    )
    solution, _ = loop.run(_project(start, problem), problem, problem)

    def newton(_, z):
        # Near the solution the cone's face is found, and Newton's method on the fixed point ends in rounding.
        missed = _fixed_point(z, problem)
        moved = z - jnp.linalg.solve(jax.jacfwd(_fixed_point)(z, problem), missed)
        better = jnp.linalg.norm(_fixed_point(moved, problem)) < jnp.linalg.norm(missed)
        return jnp.where(better, moved, z)

    return jax.lax.fori_loop(0, _NEWTON_STEPS, newton, solution)


@_projected_gradient.defjvp
def _projected_gradient_jvp(solver, primals, tangents):
    # jaxopt's own rule is reverse-mode only; the fixed-point condition serves both modes.
    problem, start = primals
    z = _projected_gradient(solver, problem, start)
    by_solution = jax.jacfwd(lambda value: _fixed_point(value, problem))(z)
    _, by_problem = jax.jvp(lambda data: _fixed_point(z, data), (problem,), (tangents[0],))
    return z, jnp.linalg.solve(by_solution, -by_problem)


def _fixed_point(z, problem):
    gradient = problem.quadratic @ z + problem.linear
    return z - _project(z - gradient, problem)


def _objective(z, problem):
    return 0.5 * z @ problem.quadratic @ z + problem.linear @ z


def _project(z, problem):
    shifted = [
        project_positive(X - floor * jnp.eye(n)) + floor * jnp.eye(n)
        for X, floor, n in zip(problem.blocks(z), problem.floors, problem.sizes)
    ]
    return jnp.concatenate([symmetric_vector(X) for X in shifted])


@functools.cache
def _jaxopt():
    """jaxopt, whose import warns that it is no longer maintained; known, and weighed in this one place."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        import jaxopt
    return jaxopt
