"""The force that the model lacks, from the measured motion, beside what the law that was found makes of it.

    b·f = E u − M q̈ − D q̇ − K q − (other laws),      every term through the same zero-phase low-pass;

of an effect that is no force (a sensor's, or one that changes the matrices): the output that the linear model misses.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import AbstractForceEffect, AbstractInputEffect, Term
from ...mechanics.runs.extended import arm_along, input_matrix_of
from ...mechanics.systems.drives import Force
from ..equation_error.band import band_of
from ..equation_error.rows import Series, contribution, series_of
from ..estimation.element_sums import at_one_threshold, elements_of
from ..findings import Curves, Finding
from ..result import Diagnosis

MOST_ROWS = 1500
"""Rows kept at most: enough to see a law by."""


@dataclass(frozen=True)
class Variable:
    """What a missing force may depend on: `name` in words, `unit`, `values` row by row."""

    name: str
    unit: str
    values: Float[np.ndarray, " rows"]


@dataclass(frozen=True)
class MissingForce:
    """What the model lacks at one place.

    `effect`, `location`: of the finding, the effect empty where there is none; `quantity`: "force", "input" or
    "output"; `unit`; `missing`: as measured, what other findings explain taken out; `law`: what the law makes of the
    measured motion, None without; `error`: its standard error; `variables`: what it may depend on; `cutoff_hz` of the
    low-pass, None where there was none.
    """

    effect: str
    location: str
    quantity: str
    unit: str
    missing: Float[np.ndarray, " rows"]
    law: Float[np.ndarray, " rows"] | None
    error: Float[np.ndarray, " rows"] | None
    variables: tuple[Variable, ...]
    cutoff_hz: float | None


def missing_forces(diagnosis: Diagnosis) -> tuple[MissingForce, ...]:
    """What the model lacks, finding by finding; at the worst output where nothing was found.

    **Arguments:** `diagnosis`.

    **Returns:** one `MissingForce` per finding of the model that has a law.
    """
    pairs = [(finding, _term_of(diagnosis, finding)) for finding in diagnosis.findings if finding.stage == "model"]
    pairs = [(finding, term) for finding, term in pairs if term is not None]
    equation = _Equation.of(diagnosis)
    if pairs:
        return tuple(
            equation.at(finding, term) if equation is not None and _is_force(term) else _as_output(diagnosis, term)
            for finding, term in pairs
        )
    if diagnosis.verdict not in ("unexplained", "partly"):
        return ()
    worst = next((f.location for f in diagnosis.findings if f.status == "unexplained"), "")
    names = diagnosis.baseline.model.output_names
    place = names.index(worst) if worst in names else 0
    return (_left(diagnosis, place) if equation is None else equation.left(place),)


def _term_of(diagnosis: Diagnosis, finding: Finding) -> Term | None:
    name = finding.effect, finding.location
    return next((t for t in diagnosis.terms if (t.effect.id, t.place.name) == name), None)


def _is_force(term: Term) -> bool:
    return isinstance(term.effect, AbstractForceEffect | AbstractInputEffect)


@dataclass(frozen=True)
class _Equation:
    """The force equation of the first record, with the final model."""

    diagnosis: Diagnosis
    series: Series
    input_map: Float[np.ndarray, "dofs inputs"]
    rest: Float[np.ndarray, "rows dofs"]
    laws: dict[tuple[str, str], Float[np.ndarray, "rows dofs"]]

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> "_Equation | None":
        """None where forces cannot be had from the record: a static gain, a driven base, measured accelerations, hidden
        coordinates."""
        model = (diagnosis.extended or diagnosis.baseline).model
        record = diagnosis.records[0]
        static = not np.any(np.asarray(model.mass))
        if static or model.hidden or not isinstance(model.drive, Force) or "acceleration" in record.measured:
            return None
        series = series_of(record, band_of([record]), at_rest=True)
        if len(series.rows) < 10:
            return None
        E = np.asarray(input_matrix_of(model.drive))
        M, D, K = (np.asarray(X) for X in (model.mass, model.damping, model.stiffness))
        inner = (series.a @ M.T + series.v @ D.T + series.q @ K.T)[series.rows]
        laws = {
            (t.effect.id, t.place.name): contribution(t.effect, t.place, t.values, series, E)
            for t in model.effects or diagnosis.terms
            if _is_force(t)
        }
        outer = series.input_rows @ E.T
        if diagnosis.beside is not None:
            outer = outer + series.row_values(diagnosis.beside)
        return cls(diagnosis, series, E, outer - inner, laws)

    def at(self, finding: Finding, term: Term) -> MissingForce:
        """What is missing where a term acts, seen along its arm, and what its law makes of it."""
        name = term.effect.id, term.place.name
        others = sum((law for key, law in self.laws.items() if key != name), np.zeros_like(self.rest))
        at_input = isinstance(term.effect, AbstractInputEffect)
        arm = arm_along(term.effect, term.place, self.input_map)
        along = arm / (arm @ arm)
        error = sum(((step @ along) ** 2 for step in self._steps(finding, term)), np.zeros(len(self.rest)))
        kept = self._kept()
        record = self.diagnosis.records[0]
        unit = record.input_units[term.place.first] if at_input else self._force_unit(arm)
        return MissingForce(
            *name,
            "input" if at_input else "force",
            unit,
            ((self.rest - others) @ along)[kept],
            (self.laws[name] @ along)[kept],
            np.sqrt(error)[kept],
            self._variables(arm, term.place.first if at_input or term.effect.places == "input" else None),
            self.series.band.high,
        )

    def left(self, place: int) -> MissingForce:
        """What is missing at a coordinate after everything that was found."""
        arm = np.eye(len(self.input_map))[place]
        total = sum(self.laws.values(), np.zeros_like(self.rest))
        name = self.diagnosis.baseline.model.output_names[place]
        return MissingForce(
            "",
            name,
            "force",
            self._force_unit(arm),
            ((self.rest - total) @ arm)[self._kept()],
            None,
            None,
            self._variables(arm, None),
            self.series.band.high,
        )

    def _steps(self, finding: Finding, term: Term):
        """Change of the law's force for one standard error of every parameter."""
        errors = {
            name: list(e) if isinstance(e := one.standard_error, tuple) else [e]
            for name, one in finding.parameters.items()
        }
        elements = elements_of(term.effect)
        groups = at_one_threshold([float(term.values[level]) for _, level in elements])
        # Elements at one threshold have one size and one threshold between them.
        together = {elements[g[0]][1]: [elements[k][1] for k in g] for g in groups}
        joined = {j for g in groups for k in g[1:] for j in elements[k]}
        for j, parameter in enumerate(term.effect.parameters):
            if j in joined:
                continue
            error = errors[parameter.name].pop(0) if errors.get(parameter.name) else None
            if error:
                values = np.array(term.values, float)
                values[together.get(j, [j])] += error
                moved = contribution(term.effect, term.place, values, self.series, self.input_map)
                step = moved - self.laws[term.effect.id, term.place.name]
                if np.all(np.isfinite(step)):
                    yield step

    def _kept(self) -> slice:
        return slice(None, None, -(-len(self.series.rows) // MOST_ROWS))

    def _force_unit(self, arm) -> str:
        units = self.diagnosis.records[0].input_units
        acting = [unit for unit, column in zip(units, self.input_map.T) if column @ arm != 0]
        return (acting or list(units))[0]

    def _variables(self, arm, channel: int | None) -> tuple[Variable, ...]:
        series, rows, kept = self.series, self.series.rows, self._kept()
        record = self.diagnosis.records[0]
        names, units = record.output_names, record.output_units
        signs = [(k, s) for k, s in enumerate(np.sign(arm)) if s]
        place = " − ".join(names[k] for k, _ in sorted(signs, key=lambda one: -one[1]))
        unit = units[signs[0][0]] if signs else ""
        if record.measured[signs[0][0] if signs else 0] == "velocity":
            unit = unit[:-2] if unit.endswith("/s") else f"{unit} s".strip()
        away = arm / max(np.abs(arm).max(), 1e-300)
        if channel is None:
            reach = np.abs(self.input_map.T @ arm)
            channel = int(np.argmax(reach)) if reach.any() else 0
        parts = [
            (_of("displacement", place), unit, (series.q @ away)[rows]),
            (_of("velocity", place), f"{unit}/s" if unit else "", (series.v @ away)[rows]),
            ("time", "s", record.time[rows]),
            (f"input {record.input_names[channel]}", record.input_units[channel], series.input_rows[:, channel]),
        ]
        return tuple(Variable(name, unit, np.asarray(values)[kept]) for name, unit, values in parts)


def _of(quantity: str, place: str) -> str:
    return quantity if place in (quantity, "position") else f"{quantity} of {place}"


def _as_output(diagnosis: Diagnosis, term: Term) -> MissingForce:
    """The output that the baseline misses where a term acts, beside what the extension mends of it."""
    names = diagnosis.baseline.model.output_names
    place = min(max(term.place.first, 0), len(names) - 1)
    curves = _in_sample(diagnosis)
    rms = np.sqrt(np.nanmean((curves.measured - curves.baseline) ** 2, axis=0))
    if term.place.name == "record" or term.place.first < 0:
        place = int(np.argmax(rms / np.array([diagnosis.noise_floor[name] or 1.0 for name in names])))
    return _output(diagnosis, curves, place, term.effect.id, term.place.name)


def _left(diagnosis: Diagnosis, place: int) -> MissingForce:
    return _output(diagnosis, _in_sample(diagnosis), place, "", diagnosis.baseline.model.output_names[place])


def _in_sample(diagnosis: Diagnosis) -> Curves:
    return next((c for c in diagnosis.curves if not c.held_out), diagnosis.curves[0])


def _output(diagnosis: Diagnosis, curves: Curves, place: int, effect: str, location: str) -> MissingForce:
    model, record = diagnosis.baseline.model, diagnosis.records[0]
    samples = min(len(curves.time), record.samples)
    known = np.isfinite(curves.measured + curves.baseline + curves.extended)[:samples, place]
    kept = np.flatnonzero(known)[:: max(-(-int(known.sum()) // MOST_ROWS), 1)]
    name, unit = model.output_names[place], model.output_units[place]
    h = float(np.median(np.diff(curves.time)))
    slope = np.gradient(curves.baseline[:, place], h)
    variables = (
        Variable(f"simulated {name}", unit, curves.baseline[kept, place]),
        Variable(f"rate of simulated {name}", f"{unit}/s" if unit else "", slope[kept]),
        Variable("time", "s", curves.time[kept]),
        Variable(f"input {record.input_names[0]}", record.input_units[0], record.u[kept, 0]),
    )
    return MissingForce(
        effect,
        location,
        "output",
        unit,
        (curves.measured - curves.baseline)[kept, place],
        (curves.extended - curves.baseline)[kept, place] if effect else None,
        None,
        variables,
        None,
    )
