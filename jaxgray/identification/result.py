"""The identification as one immutable result, and how it is put together."""

import dataclasses
from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..mechanics.matrix_units import matrix_units
from ..mechanics.model import MechanicalModel
from ..numerics.data_frames import data_frame
from ..numerics.matrices.linear_algebra import triangle
from ..numerics.notebook import Shown
from ..numerics.outcomes import RESULTS
from ..numerics.text import entry_text
from ..records import Record
from ..records.checks.defects import grid_step
from ..records.checks.preflight import preflight
from ..records.stamped import ClockError
from .hidden.evidence import HiddenEvidence
from .initialization.start import Start, model_run
from .refinement.normal_equations import Criterion, Iterate, sensitivities, without_noise
from .refinement.prior import left_open
from .refinement.refine import Refinement
from .refinement.uncertainty import Uncertainty, uncertainty
from .setup.prediction import Batch, Setting
from .setup.preparation import Signals, prepare
from .setup.structure import Structure
from .setup.units import Scaling
from .validation.colour import score_covariance
from .validation.force_noise import ForceNoise, force_noise, response_to_inputs
from .validation.residuals import Fit, ResidualTest, fit_of, information_criteria, noise_floor, residual_test
from .validation.structure_test import StructureTest, structure_test

CONTRADICTED = 10.0
"""ΔBIC of a structure over free M, D, K from which the record contradicts it."""

FORCE_NOISE = 0.01
"""Probability at which noise is said to enter at the forces."""

SHOWING = 40.0, 10.0
"""Independent samples, and size of the statistic over its limit, up to which noise at the forces may go unseen: in 7 of
42 records of 200 samples, half of whose noise was there, it did, with 10 to 25 and 4.4 to 6.9."""

FORCE_SAMPLES = 5.0
"""Independent samples of noise at a force up to which its size is hardly known: to a third at best."""

ROUNDED = 0.5
"""Standard deviation of rounding, relative to the residual, from which it does not pass for noise: other noise is then
less than half a step (Widrow & Kollár, *Quantization Noise*, 2008)."""

POOR_FIT = 80.0
"""Fit [%] below which the result says that the model simulates poorly."""


@dataclass(frozen=True)
class Identification(Shown):
    """An identified model and the evidence for it.

    `model` in the record's units; `uncertainty`: covariance and what limits it (None without refinement); `start` and
    `refinement`: where it came from; `estimation`, `validation`: fits per record; `noise_floor`: standard deviation of
    the unpredictable part per output; `residual_test`; `structure_test`; `aic`, `bic`; `noise`: noise model in words
    and figures; `warnings`: in words, and those of them that a missing law may cause as `misfits`; `scaling`,
    `setting`, `structure`: what the computation used; `fixed`: entries of the joined blocks that did not move (by
    `fix`, or the scale under base excitation); `hidden`: what is known of coordinates that no output measures, None
    where every one is measured; `clocks`: estimated offset and rate of every clock other than that of the inputs;
    `grid_kept`: whether rows at times of their own were taken as uniform, which explains them better.
    """

    model: MechanicalModel
    uncertainty: Uncertainty | None
    start: Start
    refinement: Refinement | None
    estimation: tuple[Fit, ...]
    validation: tuple[Fit, ...]
    records: tuple[Record, ...]
    validation_records: tuple[Record, ...]
    noise_floor: Float[np.ndarray, " outputs"]
    residual_test: ResidualTest
    structure_test: StructureTest | None
    aic: float
    bic: float
    noise: dict
    warnings: tuple[str, ...]
    scaling: Scaling = field(repr=False)
    setting: Setting = field(repr=False)
    structure: Structure = field(repr=False)
    fixed: Bool[np.ndarray, " entries"] = field(repr=False)
    hidden: HiddenEvidence | None = None
    clocks: tuple[ClockError, ...] = ()
    grid_kept: bool = False
    misfits: tuple[str, ...] = ()

    @property
    def mass(self) -> Float[np.ndarray, "dofs dofs"]:
        """Mass matrix."""
        return np.asarray(self.model.mass)

    @property
    def damping(self) -> Float[np.ndarray, "dofs dofs"]:
        """Damping matrix."""
        return np.asarray(self.model.damping)

    @property
    def stiffness(self) -> Float[np.ndarray, "dofs dofs"]:
        """Stiffness matrix."""
        return np.asarray(self.model.stiffness)

    @property
    def covariance(self) -> Float[np.ndarray, "entries entries"] | None:
        """Covariance of the stacked upper triangles (by columns) of mass, damping, stiffness."""
        return None if self.uncertainty is None else self.uncertainty.covariance

    @property
    def standard_errors(self) -> dict[str, Float[np.ndarray, "dofs dofs"]] | None:
        """Standard error of every entry; not a number where inputs and outputs do not determine the entry."""
        if self.uncertainty is None:
            return None
        errors = self.uncertainty.standard_errors()
        if self.hidden is None:
            return errors
        return {name: np.where(self.hidden.undetermined[name], np.nan, X) for name, X in errors.items()}

    @property
    def structure_price(self) -> tuple[int, float] | None:
        """Parameters that the structure saves, and its BIC minus that of free M, D, K: negative where it is the better
        model. None where nothing but physical matrices was asked for."""
        if self.refinement is None or self.refinement.price is None:
            return None
        price = self.refinement.price
        return price.parameters, price.delta_bic(sum(float(np.isfinite(r.y).sum()) for r in self.records))

    @property
    def fit_percent(self) -> dict[str, dict[str, float]]:
        """Fit per output on estimation and, where there are such records, validation data."""
        return self._per_output("fit_percent")

    @property
    def rmse(self) -> dict[str, dict[str, float]]:
        """Root mean square residual per output, likewise."""
        return self._per_output("rmse")

    def to_dataframe(self):
        """Entries of mass, damping and stiffness as a pandas `DataFrame`, in the order of `covariance`.

        **Returns:** a row for each, named as in `fix` ("mass[0,0]"): `value`; `standard_error`, NaN where it is not
        known; `unit`, empty where the record has none; with hidden coordinates `kind` ("set", "canonical", "open" or
        "physical").

        **Raises:** `ImportError` without pandas.
        """
        errors, units, rows = self.standard_errors, matrix_units(self.model), []
        for name in ("mass", "damping", "stiffness"):
            for r, c in zip(*triangle(self.model.dofs)):
                row = {
                    "parameter": f"{name}[{r},{c}]",
                    "value": float(getattr(self, name)[r, c]),
                    "standard_error": float("nan") if errors is None else float(errors[name][r, c]),
                    "unit": "" if units is None else units[name][r][c],
                }
                rows.append(row if self.hidden is None else row | {"kind": self.hidden.kind(name, r, c)})
        return data_frame(rows, index="parameter")

    def judged_on(self, records: list[Record]) -> "Identification":
        """The same model with its fit on these records, instead of on the pieces it was estimated from."""
        matrices = self.scaling.matrices_in(self.mass, self.damping, self.stiffness)
        fits = tuple(_fit(matrices, self.setting, self.scaling, r, prepare(r, self.scaling)) for r in records)
        of_pieces = _fit_warnings(self.estimation, self.model)
        of_records = _fit_warnings(fits, self.model)
        said = {
            name: tuple(text for text in getattr(self, name) if text not in of_pieces) + tuple(of_records)
            for name in ("warnings", "misfits")
        }
        return dataclasses.replace(self, records=tuple(records), estimation=fits, **said)

    def _per_output(self, name: str) -> dict[str, dict[str, float]]:
        result = {}
        for kind, fits in (("estimation", self.estimation), ("validation", self.validation)):
            if fits:
                # Several records: the mean, weighted by their lengths.
                weights = np.array([len(fit.simulated) for fit in fits], dtype=float)
                values = np.average([getattr(fit, name) for fit in fits], axis=0, weights=weights)
                result[kind] = {n: float(v) for n, v in zip(self.model.output_names, values)}
        return result

    def __repr__(self) -> str:
        unseen = f" ({', '.join(self.model.hidden)} measured by no output)" if self.model.hidden else ""
        lines = [f"Identification: {self.model.dofs} coordinates{unseen}, {self.start.method} start"]
        errors = self.standard_errors
        for name in ("mass", "damping", "stiffness"):
            matrix = getattr(self, name)
            for k, row in enumerate(matrix):
                spread = [None] * len(row) if errors is None else errors[name][k]
                values = "  ".join(
                    entry_text(v, e, None if self.hidden is None else self.hidden.kind(name, k, c), digits=1)
                    for c, (v, e) in enumerate(zip(row, spread))
                )
                lines.append(f"  {name if k == 0 else '':10s}{values}")
        if self.hidden is not None:
            lines += [f"  {text}" for text in self.hidden.sentences()]
        for kind, fits in self.fit_percent.items():
            lines.append(f"  fit on {kind}: " + ", ".join(f"{n} {v:.2f} %" for n, v in fits.items()))
        if self.structure_price is not None:
            saved, delta = self.structure_price
            lines.append(f"  structure: {saved} parameters fewer than free M, D, K, ΔBIC {delta:+.1f}")
        lines += [f"  warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def assess(
    model: MechanicalModel,
    records: list[Record],
    held_out: list[Record],
    setting: Setting,
    scaling: Scaling,
    signals: list[Signals],
    batch: Batch,
    structure: Structure,
    held,
    start: Start,
    refinement: Refinement | None,
    notes: tuple[str, ...],
    hidden: HiddenEvidence | None = None,
) -> Identification:
    """Fits, tests, covariance and warnings of a model found; see `Identification`."""
    matrices = scaling.matrices_in(*jax.device_get((model.mass, model.damping, model.stiffness)))
    estimation = tuple(_fit(matrices, setting, scaling, r, s) for r, s in zip(records, signals))
    validation = tuple(_fit(matrices, setting, scaling, r, prepare(r, scaling)) for r in held_out)
    floor = noise_floor(estimation[0].residual)
    tests = residual_test(estimation[0].residual, records[0].u)
    spread = found = None
    warnings, misfits = list(notes), []
    noise = {"form": "output-error"}
    parameters = 3 * model.dofs * (model.dofs + 1) // 2
    if refinement is not None:
        plain = Iterate(refinement.blocks, without_noise(refinement.nuisance), np.eye(model.outputs))
        _, J = sensitivities(plain, Criterion(batch, setting, structure))
        J = np.asarray(J)
        free = np.ones(J.shape[3], bool)
        if held is not None:
            free[: len(held)] &= ~np.asarray(held, bool)
        scaled = jax.device_get((refinement.mass, refinement.damping, refinement.stiffness))
        meat, at_forces = None, ForceNoise(1.0, np.inf, np.inf)
        if refinement.nuisance.noise is None:
            W = np.asarray(refinement.whitening)
            residuals = [fit.residual / np.asarray(scaling.outputs) @ W.T for fit in estimation]
            weighed = [np.einsum("ab,nbp->nap", W, J[k, : len(e)]) for k, e in enumerate(residuals)]
            if not tests.white:
                meat = _score_covariance(weighed, residuals)
            if not refinement.normal.cost <= 0:
                fitted, known = [rows[:, :, free] for rows in weighed], [np.nan_to_num(e) for e in residuals]
                response = response_to_inputs(setting.system(*scaled), W, max(len(e) for e in residuals))
                at_forces = force_noise(fitted, known, response)
        spread = uncertainty(refinement, scaling, structure, fixed=held, meat=meat)
        system = setting.drive.state_space(*scaled, setting.measured, 1.0)
        found = structure_test(
            records[0].y,
            estimation[0].residual,
            J[0, : records[0].samples][:, :, free] * np.asarray(scaling.outputs)[:, None],
            records[0].u,
            np.asarray(system.A),
            # Between samples a linear hold moves the outputs with the next input already.
            direct=setting.hold == "linear" or bool(np.any(np.asarray(system.D) != 0)),
        )
        parameters = refinement.normal.information.shape[0]
        if hidden is not None:
            parameters -= int(np.sum(held))
        if refinement.prior is not None:
            warnings += _open_masses(left_open(refinement.normal.information, refinement.prior, np.asarray(held, bool)))
        if refinement.price is not None:
            warnings += _dear(refinement.price.delta_bic(float(np.sum(np.asarray(batch.kept)))))
        if refinement.nuisance.noise is not None:
            values = np.asarray(refinement.nuisance.noise)
            noise = {
                "form": "innovations",
                "force_to_output_noise": np.abs(values[: batch.u.shape[2]]).tolist(),
            }
            warnings += _hardly_noisy(refinement, batch.u.shape[2], records[0].input_names)
        warnings += _warnings(spread, model, at_forces)
        misfits += _ending(refinement)
        misfits += _misfits(refinement, found, tests, model, at_forces)
        warnings += _rounded(records[0], estimation[0])
    misfits += _fit_warnings(estimation, model)
    residuals = np.concatenate([fit.residual for fit in estimation])
    complete = residuals[np.all(np.isfinite(residuals), axis=1)]
    sign, logdet = np.linalg.slogdet(complete.T @ complete / max(len(complete), 1))
    aic, bic = information_criteria(len(complete) * logdet, complete.size, parameters)
    return Identification(
        model,
        spread,
        start,
        refinement,
        estimation,
        validation,
        tuple(records),
        tuple(held_out),
        floor,
        tests,
        found,
        aic,
        bic,
        noise,
        tuple(dict.fromkeys(warnings + misfits)),
        scaling,
        setting,
        structure,
        np.asarray(held, bool),
        hidden,
        misfits=tuple(dict.fromkeys(misfits)),
    )


def _fit(matrices, setting: Setting, scaling: Scaling, record: Record, signals: Signals) -> Fit:
    run = np.asarray(model_run(matrices, setting, signals)[0])[: record.samples]
    level = np.nanmean(record.y, axis=0)
    return fit_of(record.y, run * np.asarray(scaling.outputs) + level)


def _score_covariance(sensitivities, residuals) -> np.ndarray:
    """Covariance of the scores under the colour of the residual, for as many degrees of freedom as the fit has left."""
    count = sum(int(np.isfinite(e).sum()) for e in residuals)
    return score_covariance(sensitivities, residuals) * count / max(count - sensitivities[0].shape[2], 1)


def _ending(refinement) -> list[str]:
    """What is said of a refinement that did not come to its end: a model that lacks a law may have none."""
    if refinement.result == RESULTS.successful:
        return []
    if refinement.result == RESULTS.not_improved:
        return [
            "The refinement ended no better than its start, which is kept: error bars are those of the start. Try "
            "another time constant, a longer record, or fix entries that you know."
        ]
    return [
        f"The refinement stopped after {refinement.steps[0]} + {refinement.steps[1]} steps before it had "
        "settled: the record may hardly determine some entries. Excite nearer to the natural frequencies, "
        "try another time constant, or fix entries that you know."
    ]


def _warnings(spread: Uncertainty, model, at_forces: ForceNoise) -> list[str]:
    result = [f"Parameter {name} does not move any output; fix it or excite it." for name in spread.unmoved]
    for text in spread.weak_directions:
        remedy = "Excite nearer to the natural frequencies" if "mass" in text else "Excite it more"
        result.append(f"Hardly determined by this record: {text}. {remedy}, or fix entries that you know.")
    for text in spread.at_edge:
        # No body is without mass: a record that says so does not show its inertia.
        remedy = " Excite nearer to the natural frequencies, where inertia shows." if text.startswith("mass") else ""
        result.append(f"At the edge of what is physical: {text}; its error bar is one-sided.{remedy}")
    errors, mass = spread.standard_errors()["mass"], np.asarray(model.mass)
    for k, name in enumerate(model.output_names):
        if errors[k, k] > 0.5 * abs(mass[k, k]):
            result.append(
                f"No inertia visible at {name}: mass {mass[k, k]:.3g} ± {errors[k, k]:.2g}. Excite nearer "
                "to the natural frequencies."
            )
    if not at_forces.chance < FORCE_NOISE and at_forces.samples < SHOWING[0] and at_forces.shown < SHOWING[1]:
        result.append(
            "So short a record may not show noise at the forces: if there is any, error bars are too small. Record "
            "more, or use noise='innovations'."
        )
    return result


def _misfits(
    refinement, found: StructureTest, tests: ResidualTest, model: MechanicalModel, at_forces: ForceNoise
) -> list[str]:
    """What the residual has that noise of the sensors has not."""
    result = []
    if not found.fits:
        result.append(
            f"M, D, K of {model.dofs} coordinates do not fit: another linear model "
            f"explains {found.explained_percent:.1f} % more of the residual (p = {found.p_value:.1e}). "
            "More coordinates, a delay, or another input map may be needed."
        )
    if not tests.white and refinement.nuisance.noise is None:
        result.append(
            "The residual is not white: error bars allow for its colour, not for a controller that feeds it back; if "
            "noise enters at the forces, noise='innovations' is more exact."
        )
    if at_forces.chance < FORCE_NOISE:
        result.append(
            f"The residual is largest where the system answers forces (p = {at_forces.chance:.1e}): if noise enters "
            "at the forces, error bars are too small, the more so the lighter the damping. Use noise='innovations'."
        )
    if tests.feedback:
        biased = "" if tests.white else " If so, noise of this colour biases M, D, K by more than their error bars."
        result.append(f"The residual is correlated with future inputs: the record may come from a closed loop.{biased}")
    return result


def _open_masses(count: int) -> list[str]:
    if not count:
        return []
    return [
        f"Base excitation leaves {count} mass ratio{'s' * (count > 1)} open where damping is nearly proportional: "
        "masses were kept near equal ones. M⁻¹D, M⁻¹K and the modes are determined, single entries are not; give "
        "masses with fix, or a structure such as diagonal-mass."
    ]


def _dear(delta_bic: float) -> list[str]:
    if not delta_bic > CONTRADICTED:
        return []
    return [f"The record contradicts the structure asked for (ΔBIC {delta_bic:.3g}); free M, D, K fit better."]


def _hardly_noisy(refinement: Refinement, inputs: int, names: tuple[str, ...]) -> list[str]:
    ratios, errors = (np.asarray(X)[:inputs] for X in (refinement.nuisance.noise, refinement.noise_errors))
    # The variance of a variance from n samples is 2/n of its square; a ratio is a square root of one.
    worth = ratios**2 / np.maximum(2 * errors**2, 1e-300)
    open_ones = [name for name, n in zip(names, worth) if not n > FORCE_SAMPLES]
    if not open_ones:
        return []
    return [
        f"Noise at the forces is hardly determined by this record ({', '.join(open_ones)}): if it is larger than "
        "found, error bars are too small, the more so the lighter the damping."
    ]


def _rounded(record: Record, fit: Fit) -> list[str]:
    steps = {name: grid_step(y) for name, y in zip(record.output_names, record.y.T)}
    coarse = {
        name: steps[name]
        for name, rmse in zip(record.output_names, fit.rmse)
        if steps[name] is not None and steps[name] / np.sqrt(12) > ROUNDED * rmse
    }
    if not coarse:
        return []
    said = {one.location for one in preflight(record, relations=False) if one.effect == "sensor_quantization"}
    return [
        f"Most of the noise at {name} is rounding to steps of {step:.3g}: it repeats where the motion does, but "
        "error bars take it for independent from sample to sample. Use a finer resolution."
        for name, step in coarse.items()
        if name not in said
    ]


def _fit_warnings(estimation, model) -> list[str]:
    return [
        f"Poor fit at {name}: {fit:.1f} % on the estimation record."
        for name, fit in zip(model.output_names, estimation[0].fit_percent)
        if not fit > POOR_FIT
    ]
