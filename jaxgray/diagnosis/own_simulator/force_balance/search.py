"""The search for laws in the balance of forces of a simulator, judged by its runs over windows."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ....mechanics.effects.base import AbstractEffect, AbstractForceEffect, Term
from ....mechanics.model import MechanicalModel
from ....mechanics.systems.drives import Force
from ....numerics.outcomes import RESULTS, ComputationError
from ....numerics.progress import AbstractProgress
from ....records import Record
from ...equation_error.band import band_of
from ...equation_error.library import Library
from ...equation_error.regression import ForceFit
from ...equation_error.rows import forces_along, series_of
from ...equation_error.search import Search, Table
from ...equation_error.windows import Windows, window_samples
from .equation import Balanced, BalanceEquation, prepared

FEWEST = 8
"""Rows a number that there must be."""


@dataclass(kw_only=True)
class BalanceSearch(Search):
    """The selection in the balance of forces of a simulator."""

    @property
    def equation(self) -> BalanceEquation:
        """The rows."""
        return self.table.equation

    def model(self, fit: ForceFit) -> MechanicalModel:
        """What stands for the simulator: its mean masses and inputs, and the laws."""
        first = self.records[0]
        none = np.zeros((first.outputs, first.outputs))
        return MechanicalModel(
            self.equation.mean_mass(),
            none,
            none,
            drive=Force(self.equation.mean_input_map()),
            measured=first.measured,
            input_names=first.input_names,
            output_names=first.output_names,
            input_units=first.input_units,
            output_units=first.output_units,
            effects=tuple(Term(t.effect, t.place, jnp.asarray(t.values)) for t in fit.terms),
        )

    def matrix_errors(self, fit):
        return None

    def run(self, fit):
        """Runs over windows, the laws as forces along the measured motion."""
        equation, windows = self.equation, self.windows
        u = windows.cut([record.u for record in self.records + self.held])
        w = windows.cut([-self._laws(fit.terms, series) for series in windows.series])

        def runs(states: Float[np.ndarray, "windows runs states"]) -> np.ndarray:
            count, many, size = states.shape
            flat = (states.reshape(-1, size), *(np.repeat(x, many, axis=0) for x in (u, w)))
            made = equation.windows(*flat, fit)
            return made.reshape(count, many, *made.shape[1:])

        found = windows.fitted(runs)
        return found[: len(self.records)], found[len(self.records) :]

    def _laws(self, terms: tuple[Term, ...], series) -> Float[np.ndarray, "samples dofs"]:
        made = [forces_along(t.effect, t.place, t.values, series, self.equation.input_map) for t in terms]
        return sum(made, np.zeros_like(series.q))


def search_balance(
    simulator: Balanced,
    names: tuple[str, ...],
    given: Float[np.ndarray, " numbers"],
    records: list[Record],
    held: list[Record],
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    *,
    rng: np.random.Generator,
    progress: AbstractProgress,
) -> BalanceSearch:
    """Numbers, then laws one by one, until nothing more is found.

    **Arguments:** `simulator`, `names` and `given` values of its numbers; `records`, `held`: to fit, and to judge, of
    displacements; `catalogue`; `max_effects`; `rng`: of the resampling; `progress`.

    **Raises:** `ComputationError` where there is too little motion above the noise.
    """
    progress.unlimited.stage("setting up the balance of forces")
    band = band_of(records)
    series = [series_of(record, band) for record in records]
    equation = BalanceEquation(simulator, names, given, records, series)
    if not any(np.any(rows) for rows in equation.driven):
        raise ComputationError(RESULTS.unreachable, stage="balance of forces", detail="no actuator acts")
    rows = min(len(one.rows) for one in equation.series)
    if rows < FEWEST * len(names) + FEWEST:
        detail = f"{rows} rows of motion below {band.high:.3g} Hz in the shortest record"
        raise ComputationError(RESULTS.too_short, stage="balance of forces", detail=detail)
    laws = tuple(one for one in catalogue if isinstance(one, AbstractForceEffect) and one.places != "input")
    progress.unlimited.stage("looking for effects")
    library = Library.of(equation, laws, (records[0].input_names, records[0].output_names))
    table, drive = Table(equation, library, _settled(equation), progress), Force(np.eye(equation.dofs))
    search = BalanceSearch(records=records, held=held, rng=rng, progress=progress, drive=drive, table=table)
    search.base = search.fit = table.base
    everything = [prepared(record, series_of(record, band, at_rest=True)) for record in records + held]
    nothing = [np.zeros(record.samples, bool) for record in records + held]
    search.windows = Windows(records + held, everything, window_samples(records + held), nothing)
    search.select(max_effects)
    search.recount()
    return search


def _settled(equation: BalanceEquation) -> ForceFit:
    """The numbers alone, with the weight of what they leave.

    **Raises:** `ComputationError` where nothing finite fits.
    """
    first = equation.fit((), equation.plain())
    found = None if first is None else equation.fit((), equation.weight_of(first.residual))
    if found is None:
        raise ComputationError(RESULTS.nonfinite, stage="balance of forces", detail="no numbers fit the record")
    return found
