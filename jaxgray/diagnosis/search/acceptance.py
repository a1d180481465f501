"""Whether an attempt may be believed: what speaks against it, and what it gains on data that the fit has not seen."""

import numpy as np

from ...identification.validation import residual_test
from ...mechanics.effects.sensor import SensorCrosstalk
from ..estimation.context import Bench
from ..estimation.multistart import Attempt, unresolved
from ..estimation.significance import at_bound, significance
from ..model.free_run import overall
from ..model.held_out_gain import gain_of
from ..model.parameter_vector import Layout
from ..noise.floor import residual_rms
from ..settings import ACCEPTED, CLEAR, SIGNIFICANT
from .state import Growth, held_out_run, is_local, runs_seen

MOVED_ALONG = 2.0
"""Standard errors of an amplitude that are enough where the likelihood is clear."""

UNSURE = "standard errors from nothing"
"""Why an amplitude does not count."""

EXPLAINED = 0.1
"""Least share of the excess that a finding must explain."""


def floor_of(bench: Bench, attempts: list[Attempt]) -> np.ndarray:
    """Noise floor per output: the independent one, or what the best refit leaves."""
    if bench.floor is not None:
        return bench.floor
    if not attempts:
        return np.ones(bench.simulator.setup.dofs)
    return residual_rms(attempts[0].fit.residual[0], bench.data[0])


def unsound(bench: Bench, growth: Growth, attempt: Attempt, given_shape: bool = False) -> str | None:
    """What speaks against an attempt whatever it gains, None for nothing. `given_shape`: with the errors that sizes
    have beside a shape that is known."""
    last = len(attempt.fit.candidate.terms) - 1
    if attempt.delta_bic < ACCEPTED:
        return f"the refit explains too little (ΔBIC {attempt.delta_bic:.0f})"
    if _fed_back(bench, growth, attempt):
        return "the inputs follow what it leaves: a closed loop looks the same"
    bound = at_bound(attempt.fit, last)
    if bound is not None:
        return f"{bound} ran to its physical bound"
    other_law = unresolved(attempt.fit, attempt.score)
    if other_law is not None:
        return other_law
    layout = Layout(bench.simulator.setup, attempt.fit.candidate)
    size = significance(attempt.fit, layout, last, given_shape=given_shape)
    # An amplitude that a shape moves along with has a wide error, though nothing explains the record without it.
    least = SIGNIFICANT if attempt.delta_bic < CLEAR else MOVED_ALONG
    return f"only {size:.1f} {UNSURE}" if size < least else None


def judged(bench: Bench, growth: Growth, attempt: Attempt, floor: np.ndarray, given_shape: bool = False):
    """Why an attempt cannot be believed (None if it can), its gain, and its free runs on held-out data; `given_shape`
    as for `unsound`."""
    why = unsound(bench, growth, attempt, given_shape)
    if why is not None:
        return why, None, None
    here = growth.sure
    if not np.all(residual_rms(attempt.fit.residual[0], bench.data[0]) < 2 * residual_rms(here.e, bench.data[0])):
        return "its free run leaves more than it explains", None, None
    before = overall(residual_rms(here.e, bench.data[0]), floor) ** 2
    after = overall(residual_rms(attempt.fit.residual[0], bench.data[0]), floor) ** 2
    if after > before:
        return "its free run leaves more than the model without it", None, None
    if before - after < EXPLAINED * max(before - 1.0, 0.0):
        share = 100 * (before - after) / (before - 1.0)
        return f"explains only {share:.0f} % of the excess", None, None
    names = bench.names[1]
    seen = runs_seen(bench, here.e, attempt.fit.residual[0], growth.start.e)
    if is_local(bench, attempt.name[0]) or not bench.validation:
        runs = growth.runs
        gain = gain_of(*seen, floor, names, held_out=False, rng=bench.rng)
        # What was fitted to these data always gains a little. Beside what it mends itself: how far the error varied
        # that earlier findings took away is nothing to it.
        left, after, _ = seen
        alone = gain_of(left, after, left, floor, names, held_out=False, rng=bench.rng)
        sure = alone.ci99_lower > 0 and alone.ci95[0] > 0
        return (None if sure else "no sure gain, even on the data of the fit"), gain, runs
    runs = [held_out_run(bench, attempt.fit.candidate, d) for d in bench.validation]
    if not all(np.all(np.isfinite(run.e)) for run in runs):
        return "its free run on held-out data overflows", None, None
    gain = gain_of(growth.runs, runs, growth.baseline_runs, floor, names, held_out=True, rng=bench.rng, seen=seen)
    if not gain.ci99_lower > 0:
        return f"no sure gain on held-out data ({gain.percent:.1f} %, from {gain.ci99_lower:.1f} %)", gain, None
    if growth.credit is not None:
        lent = growth.accepted[-1].runs
        more = gain_of(lent, runs, growth.baseline_runs, floor, names, held_out=True, rng=bench.rng)
        if not more.ci99_lower > 0:
            return "no sure gain on held-out data beyond that of what was lent its place", more, None
    return None, gain, runs


def _fed_back(bench: Bench, growth: Growth, attempt: Attempt) -> bool:
    """Whether crosstalk from an input stands for a closed loop that feeds the noise back to the inputs; such crosstalk
    is then no longer looked for."""
    inputs, outputs = bench.names
    from_inputs = frozenset((SensorCrosstalk.id, f"{u}->{y}") for u in inputs for y in outputs)
    if attempt.name not in from_inputs:
        return False
    data = bench.data[0]
    e = np.where(data.kept, attempt.fit.residual[0], np.nan)[: data.samples]
    if not residual_test(e, data.u[: data.samples]).followed:
        return False
    growth.ruled_out |= from_inputs
    return True
