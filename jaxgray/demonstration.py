"""The paper's simulated system: known mass, damping, stiffness and a hidden effect, found from noisy records."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from rich.console import Console

from .demonstration_effects import NOISE, SAMPLES, SAMPLING_TIME, TRUTH, Hidden, simulated
from .diagnosis.diagnose import diagnose
from .diagnosis.result import Diagnosis
from .diagnosis.words.titles import title_of, value_text
from .identification.validation.residuals import fit_of
from .numerics.progress import AbstractProgress
from .numerics.text import plus_minus
from .records import Record
from .report import terminal

PUBLISHED = {"mass": 0.0303, "damping": 0.125, "stiffness": 0.00108}
"""Relative Frobenius errors that the paper reports for its method."""


@dataclass(frozen=True)
class Demonstration:
    """What was simulated and what was found.

    `estimation`, `validation`: noisy records; `clean`: the validation outputs without noise; `hidden`: effects that
    the linear model lacks; `diagnosis`; `seed`.
    """

    estimation: Record
    validation: Record
    clean: Float[np.ndarray, "samples outputs"]
    hidden: tuple[Hidden, ...]
    diagnosis: Diagnosis
    seed: int

    @property
    def models(self) -> dict[str, dict[str, Float[np.ndarray, "dofs dofs"]]]:
        """Mass, damping and stiffness of every model on the way, by what it is called."""
        found = {}
        if self.diagnosis.identification is not None and not self.hidden:
            fitted = self.diagnosis.identification
            start = fitted.scaling.matrices_out(*fitted.start.matrices)
            found["subspace start"] = dict(zip(TRUTH, (np.asarray(X) for X in start)))
        linear = "linear model" if self.hidden else "refined"
        summaries = {linear: self.diagnosis.baseline, "extended model": self.diagnosis.extended}
        for name, summary in summaries.items():
            if summary is not None:
                found[name] = {matrix: np.asarray(getattr(summary.model, matrix)) for matrix in TRUTH}
        return found

    @property
    def clean_fit_percent(self) -> dict[str, Float[np.ndarray, " outputs"]]:
        """Fit of the free runs to the validation outputs without noise, by model; empty without such runs."""
        runs = [c for c in self.diagnosis.curves if c.held_out and c.baseline.shape == self.clean.shape]
        if not runs:
            return {}
        names = ["linear model"] + ([] if self.diagnosis.extended is None else ["extended model"])
        fits = {}
        for name, run in zip(names, (runs[0].baseline, runs[0].extended)):
            known = np.all(np.isfinite(run), axis=1)
            fits[name] = fit_of(self.clean[known], run[known]).fit_percent
        return fits


def errors(matrices: dict[str, np.ndarray]) -> dict[str, float]:
    """Relative Frobenius errors ‖X − X_true‖/‖X_true‖ of mass, damping, stiffness."""
    return {name: float(np.linalg.norm(matrices[name] - true) / np.linalg.norm(true)) for name, true in TRUTH.items()}


def demonstrate(
    effect: str = "coulomb_friction", seed: int = 1, *, samples: int = SAMPLES, progress: AbstractProgress | None = None
) -> Demonstration:
    """Simulate an estimation and a validation record with a hidden effect, and diagnose.

    **Arguments:** `effect`: id of what is hidden, "none" for nothing; `seed` of inputs and noise; `samples` of each
    record; `progress`: silent by default.

    **Returns:** a `Demonstration`.

    **Raises:** `ValueError` for an effect that cannot be demonstrated, or a seed that is none.
    """
    estimation, validation, clean, hidden = simulated(effect, seed, samples)
    found = diagnose(estimation, validation=validation, seed=seed, progress=progress)
    return Demonstration(estimation, validation, clean, hidden, found, seed)


def truth_document(made: Demonstration) -> dict:
    """What was simulated, as JSON; `mass`, `damping` and `stiffness` stand where `--model` finds them."""
    return {
        "schema": "jaxgray/truth/1",
        **{name: true.tolist() for name, true in TRUTH.items()},
        "seed": made.seed,
        "sampling_time": SAMPLING_TIME,
        "samples": made.estimation.samples,
        "noise": NOISE,
        "effects": [
            {"effect": one.effect, "location": one.location, "parameters": one.parameters} for one in made.hidden
        ],
    }


def show(out: Console, made: Demonstration, document: dict) -> None:
    """The verdict, then truth beside finding: the hidden effect, mass, damping and stiffness, fits.

    **Arguments:** `out`: where to; `made`; `document`: by `diagnosis_document`.
    """
    out.print(document["sentence"], style="bold", soft_wrap=True)
    _show_effects(out, made, document)
    models = made.models
    spread = document["baseline"]["model"]["standard_errors"], (document["extended"] or {}).get("model", {})
    known = {"refined": spread[0], "linear model": spread[0], "extended model": spread[1].get("standard_errors")}
    table = terminal.new_table("entry", "truth", *models)
    for name, true in TRUTH.items():
        for r, c in ((0, 0), (0, 1), (1, 1)):
            cells = []
            for model, matrices in models.items():
                error = known.get(model) and known[model][name][r][c]
                cells.append(plus_minus(float(matrices[name][r, c]), error))
            table.add_row(f"{name}[{r},{c}]", f"{true[r, c]:g}", *cells)
    out.print(table)
    table = terminal.new_table("relative error ‖X − X_true‖/‖X_true‖", *TRUTH)
    rows = {name: errors(matrices) for name, matrices in models.items()}
    if not made.hidden:
        rows["published"] = PUBLISHED
    for title, values in rows.items():
        table.add_row(title, *(f"{values[name]:.3g}" for name in TRUTH))
    out.print(table)
    _show_fits(out, made, document)
    terminal.show_warnings(out, document["warnings"])


def _show_effects(out: Console, made: Demonstration, document: dict) -> None:
    """What was hidden beside what was found of it, and what was found besides."""
    names = made.estimation.output_names
    findings = [one for one in document["findings"] if one["stage"] == "model"]
    members = [(one, member) for one in findings for member in (one, *one["members"])]
    table = terminal.new_table("hidden", "truth", "found ± standard error")
    claimed = []
    for truth in made.hidden:
        match = next((m for m in members if (m[1]["effect"], m[1]["location"]) == (truth.effect, truth.location)), None)
        if match is not None:
            claimed.append(match[0])
        title = title_of(truth.effect, truth.location, names)
        for name, value in truth.parameters.items():
            one = match and match[1]["parameters"].get(name)
            text = "not found" if match is None else "–"
            if one:
                text = value_text(one["value"], one["standard_error"], one["unit"])
            table.add_row(f"{title}: {name}", value_text(value, None), text)
    if made.hidden:
        out.print(table)
    for one in findings:
        if not any(one is other for other in claimed):
            out.print(f"found without being there: {title_of(one['effect'], one['location'], names)}", soft_wrap=True)


def _show_fits(out: Console, made: Demonstration, document: dict) -> None:
    """Fits on the validation record, to what was measured and to what was really there."""
    parts = {"refined" if not made.hidden else "linear model": "baseline", "extended model": "extended"}
    table = terminal.new_table("fit on the validation record", *made.estimation.output_names)
    for name, part in parts.items():
        if document[part] is not None:
            fits = document[part]["fit_percent"]["validation"].values()
            table.add_row(f"{name} to the noisy output", *("–" if v is None else f"{v:.2f} %" for v in fits))
    for name, fits in made.clean_fit_percent.items():
        table.add_row(f"{name} to the output without noise", *(f"{v:.3f} %" for v in fits))
    out.print(table)
