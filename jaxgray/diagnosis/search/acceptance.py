"""What speaks for and against an attempt of the free-run search, and what it gains on held-out data."""

from dataclasses import dataclass

import numpy as np

from ...identification.validation.residuals import residual_test
from ...mechanics.effects.sensor import SensorCrosstalk
from ..acceptance import AbstractEvidence, negligible, unproven, unsound
from ..estimation.context import SearchContext
from ..estimation.multistart import Attempt, unresolved
from ..estimation.significance import at_bound, significance
from ..findings import Reason, Refusal
from ..model.free_run import overall
from ..model.held_out_gain import gain_of
from ..model.parameter_vector import Layout
from ..noise.floor import residual_rms
from .state import SearchState, held_out_run, held_out_runs, is_local, runs_seen


def floor_of(context: SearchContext, attempts: list[Attempt]) -> np.ndarray:
    """Noise floor per output: the independent one, or what the best refit leaves."""
    if context.floor is not None:
        return context.floor
    if not attempts:
        return np.ones(context.simulator.setup.outputs)
    return residual_rms(attempts[0].fit.residual[0], context.data[0])


@dataclass(frozen=True)
class Evidence(AbstractEvidence):
    """What the data of the fit say of an attempt. `floor`: noise per output, by which the excess is counted."""

    context: SearchContext
    state: SearchState
    attempt: Attempt
    floor: np.ndarray

    @property
    def delta_bic(self) -> float:
        return self.attempt.delta_bic

    def follows_inputs(self):
        return _is_feedback(self.context, self.state, self.attempt)

    def bound(self):
        fit, given = self.attempt.fit, self.context.simulator.setup.own
        return at_bound(fit, len(fit.candidate.terms) - 1, given)

    def other_law(self):
        return unresolved(self.attempt.fit, self.attempt.score)

    def size(self):
        fit = self.attempt.fit
        layout = Layout(self.context.simulator.setup, fit.candidate)
        return significance(fit, layout, len(fit.candidate.terms) - 1)

    def explained(self):
        before, after = self.excess()
        return (before - after) / max(before - 1.0, 1e-300) if before > 1.0 else np.inf

    def excess(self) -> tuple[float, float]:
        """Mean square error of the free run in units of the noise, without it and with it."""
        data = self.context.data[0]
        residuals = self.state.sure.e, self.attempt.fit.residual[0]
        return tuple(overall(residual_rms(e, data), self.floor) ** 2 for e in residuals)


def tested(context: SearchContext, state: SearchState, attempt: Attempt, floor: np.ndarray):
    """Why an attempt is refused (None if it is not), its gain, and its free runs on held-out data."""
    evidence = Evidence(context, state, attempt, floor)
    why = unsound(evidence)
    if why is not None:
        return why, None, None
    here = state.sure
    if not np.all(residual_rms(attempt.fit.residual[0], context.data[0]) < 2 * residual_rms(here.e, context.data[0])):
        return Refusal(Reason.WORSE, "its free run leaves more than it explains"), None, None
    before, after = evidence.excess()
    if after > before:
        return Refusal(Reason.WORSE, "its free run leaves more than the model without it"), None, None
    if (why := negligible(evidence, "the excess")) is not None:
        return why, None, None
    names = context.names[1]
    seen = runs_seen(context, here.e, attempt.fit.residual[0], state.start.e)
    if is_local(context, attempt.score.shape.effect) or not context.validation:
        runs = held_out_runs(context, attempt.fit.candidate, state.runs)
        # What happened once need not show in every part of the record.
        options = {"held_out": False, "rng": context.rng, "once": bool(attempt.score.shape.effect.onset)}
        gain = gain_of(*seen, floor, names, **options)
        # What was fitted to these data always gains a little. Beside what it mends itself: how far the error varied
        # that earlier findings took away is nothing to it.
        left, after, _ = seen
        alone = gain_of(left, after, left, floor, names, **options)
        sure = alone.ci99_lower > 0 and alone.ci95[0] > 0
        why = None if sure else Refusal(Reason.NO_SURE_GAIN, "no sure gain, even on the data of the fit")
        return why, gain, runs
    runs = [held_out_run(context, attempt.fit.candidate, d) for d in context.validation]
    if not all(np.all(np.isfinite(run.e)) for run in runs):
        return Refusal(Reason.NOT_SIMULATED, "its free run on held-out data overflows"), None, None
    state.trials += 1
    options = {"held_out": True, "rng": context.rng, "trials": state.trials}
    gain = gain_of(state.runs, runs, state.baseline_runs, floor, names, seen=seen, **options)
    if (why := unproven(gain)) is not None:
        return why, gain, None
    if state.provisional is not None:
        before = state.accepted[-1].runs
        more = gain_of(before, runs, state.baseline_runs, floor, names, **options)
        if unproven(more) is not None:
            why = "no sure gain on held-out data beyond that of the provisional finding"
            return Refusal(Reason.NO_SURE_GAIN, why), more, None
    return None, gain, runs


def _is_feedback(context: SearchContext, state: SearchState, attempt: Attempt) -> bool:
    """Whether crosstalk from an input stands for a closed loop that feeds the noise back to the inputs; such crosstalk
    is then no longer looked for."""
    inputs, outputs = context.names
    from_inputs = frozenset((SensorCrosstalk.id, f"{u}->{y}") for u in inputs for y in outputs)
    if attempt.name not in from_inputs:
        return False
    data = context.data[0]
    e = np.where(data.kept, attempt.fit.residual[0], np.nan)[: data.samples]
    if not residual_test(e, data.u[: data.samples]).followed:
        return False
    state.ruled_out |= from_inputs
    return True
