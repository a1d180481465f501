"""The paper's simulated system: known mass, damping and stiffness, found again from noisy records."""

from dataclasses import dataclass

import numpy as np
import scipy.signal
from jaxtyping import Float
from rich.console import Console

from .identification import Identification, identify
from .identification.validation import fit_of
from .numerics.progress import AbstractProgress
from .records import Record, random_steps
from .report import terminal

TRUTH = {
    "mass": np.array([[5.0, -1.0], [-1.0, 1.0]]),
    "damping": np.array([[5.0, -0.01], [-0.01, 1.0]]),
    "stiffness": np.array([[100.0, -5.0], [-5.0, 100.0]]),
}
PUBLISHED = {"mass": 0.0303, "damping": 0.125, "stiffness": 0.00108}
"""Relative Frobenius errors that the paper reports for its method."""

SAMPLING_TIME = 0.005
SAMPLES = 20_000
HOLD_TIMES = (0.5, 3.0)
NOISE = 3e-4


@dataclass(frozen=True)
class Demonstration:
    """What was simulated and what was found.

    `estimation`, `validation`: noisy records; `clean`: the validation outputs without noise; `result`;
    `start`: mass, damping, stiffness of the subspace start; `seed`.
    """

    estimation: Record
    validation: Record
    clean: Float[np.ndarray, "samples outputs"]
    result: Identification
    start: dict[str, Float[np.ndarray, "dofs dofs"]]
    seed: int

    def errors(self, matrices: dict[str, np.ndarray]) -> dict[str, float]:
        """Relative Frobenius errors ‖X − X_true‖/‖X_true‖ of mass, damping, stiffness."""
        return {
            name: float(np.linalg.norm(matrices[name] - true) / np.linalg.norm(true))
            for name, true in TRUTH.items()
        }

    @property
    def refined(self) -> dict[str, Float[np.ndarray, "dofs dofs"]]:
        """Mass, damping and stiffness after refinement."""
        return {name: getattr(self.result, name) for name in TRUTH}

    @property
    def clean_fit_percent(self) -> Float[np.ndarray, " outputs"]:
        """Fit of the free run to the validation outputs without noise."""
        return fit_of(self.clean, self.result.validation[0].simulated).fit_percent


def simulated(rng: np.random.Generator, samples: int = SAMPLES) -> tuple[Record, np.ndarray]:
    """A noisy record of the paper's system from rest, and its outputs without noise, by SciPy.

    **Arguments:** `rng`; `samples`.

    **Returns:** a `Record`, and the outputs.

    **Reference:** Olofsson et al., equation (25) and the simulation that follows it.
    """
    M, D, K = TRUTH.values()
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros((n, n)), np.linalg.inv(M)])
    C, none = np.eye(n, 2 * n), np.zeros((n, n))
    system = scipy.signal.cont2discrete((A, B, C, none), SAMPLING_TIME)
    u = random_steps(samples, n, SAMPLING_TIME, hold_times=HOLD_TIMES, rng=rng)
    clean = scipy.signal.dlsim(system, u)[1]
    y = clean + NOISE * rng.standard_normal(clean.shape)
    units = {"input_units": ("N", "N"), "output_units": ("m", "m")}
    return Record(u, y, SAMPLING_TIME, **units), clean


def demonstrate(
    seed: int = 1, *, samples: int = SAMPLES, progress: AbstractProgress | None = None
) -> Demonstration:
    """Simulate an estimation and a validation record, and identify.

    **Arguments:** `seed` of inputs and noise; `samples` of each record; `progress`: silent by default.

    **Returns:** a `Demonstration`.

    **Raises:** `ValueError` for a seed that is none.
    """
    if seed < 0:
        raise ValueError(f"seed={seed} is negative; give a whole number from 0.")
    rng = np.random.default_rng(seed)
    estimation, _ = simulated(rng, samples)
    validation, clean = simulated(rng, samples)
    result = identify(estimation, validation=validation, progress=progress)
    start = (np.asarray(X) for X in result.scaling.matrices_out(*result.start.matrices))
    return Demonstration(estimation, validation, clean, result, dict(zip(TRUTH, start)), seed)


def truth_document(made: Demonstration) -> dict:
    """What was simulated, as JSON; `mass`, `damping` and `stiffness` stand where `--model` finds them."""
    return {
        "schema": "jaxgray/truth/1",
        **{name: true.tolist() for name, true in TRUTH.items()},
        "seed": made.seed,
        "sampling_time": SAMPLING_TIME,
        "samples": made.estimation.samples,
        "noise": NOISE,
        "effects": [],
    }


def show(out: Console, made: Demonstration, document: dict) -> None:
    """Truth, start and refined model side by side, their errors beside the paper's, and the fits.

    **Arguments:** `out`: where to; `made`; `document`: by `identification_document`.
    """
    out.print(terminal.verdict(document), style="bold", soft_wrap=True)
    errors = document["model"]["standard_errors"]
    table = terminal.new_table("entry", "truth", "subspace start", "refined ± standard error")
    for name, true in TRUTH.items():
        for r, c in ((0, 0), (0, 1), (1, 1)):
            table.add_row(
                f"{name}[{r},{c}]",
                f"{true[r, c]:g}",
                f"{made.start[name][r, c]:.5g}",
                terminal.plus_minus(float(made.refined[name][r, c]), errors[name][r][c]),
            )
    out.print(table)
    start, refined = made.errors(made.start), made.errors(made.refined)
    table = terminal.new_table("relative error ‖X − X_true‖/‖X_true‖", *TRUTH)
    for title, values in (("subspace start", start), ("refined", refined), ("published", PUBLISHED)):
        table.add_row(title, *(f"{values[name]:.3g}" for name in TRUTH))
    out.print(table)
    table = terminal.new_table("fit on the validation record", *document["model"]["output_names"])
    noisy = document["fit_percent"]["validation"].values()
    table.add_row("to the noisy output", *(f"{v:.2f} %" for v in noisy))
    table.add_row("to the output without noise", *(f"{v:.3f} %" for v in made.clean_fit_percent))
    out.print(table)
