"""A law that ended in a local optimum, restarted from other values that explain more of the record.

Where its shape has little slope between one value and the next, a refit ends where it began to look. Given M, D, K
many values are scored by least squares, and the best are refitted.
"""

from collections.abc import Callable

import numpy as np

from ...mechanics.effects.base import Term
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..model.candidate import Candidate
from ..model.parameter_vector import Layout
from ..noise.whitening import NoiseModel, white_noise_model
from ..screening.features import features
from ..screening.linearization import as_answered, run_about, sampled_plant, stage_of
from ..screening.projections import Products
from ..screening.scales import scales_at
from ..screening.spectral_lines import lines_of
from .context import SearchContext, noise_model_of, stage_of_candidate
from .gauss_newton import Refit, refit
from .normal_equations import Equations

FIRST_STEPS = 3
"""Of every refit from other values, after which the best few are carried on."""

CARRIED_ON = 4
"""Refits from other values that are carried to their end."""

TURNS = 3
"""Times that values are chosen, every time with M, D, K of the refit before, as long as that pays."""


def something_left(noise_model: NoiseModel) -> bool:
    """Whether a refit leaves more than white noise at the samples."""
    return noise_model.ratio > 0.0 or predictable(noise_model)


def predictable(noise_model: NoiseModel) -> bool:
    """Whether what a refit leaves at some output can be predicted, its innovations being well below it."""
    return bool(np.any(np.diag(noise_model.lower) < settings.WHITE_INNOVATIONS * noise_model.level))


def from_other_values(
    context: SearchContext,
    fit: Refit,
    chosen: Callable[[Refit, NoiseModel], list[np.ndarray]],
    *,
    max_steps: int,
    tolerance: float,
    worth: float | None = None,
) -> Refit:
    """A refit, or a better one from other values of its last term.

    **Arguments:** `context`; `fit`: carried to its end; `chosen`: values of the last term to begin from, given a refit
    and the noise model to score them by; `max_steps`, `tolerance`: of the refits; `worth`: difference in N ln cost from
    which another one is better, default `MIN_DELTA_BIC`.
    """
    worth = settings.MIN_DELTA_BIC if worth is None else worth
    noise_model = noise_model_of(context, fit)
    data, options = context.data[0], {"held": context.held, "max_steps": max_steps, "tolerance": tolerance}

    def ends(starts: list[Candidate], white: NoiseModel, most: float, **more) -> list[tuple[Refit, NoiseModel]]:
        def begun(candidate):
            # Only what promises more than the refit that it may replace is carried on.
            again = refit(context.simulator, candidate, context.data, white, abandon=most, **options | more)
            return None if again is None else (again, noise_model_of(context, again))

        return sorted(filter(None, side_by_side(begun, starts)), key=lambda end: end[1].cost)

    for _ in range(TURNS):
        candidate, term = fit.candidate, fit.candidate.terms[-1]
        system = sampled_plant(context.simulator.plant(fit.candidate), data, context.simulator.setup.outputs)
        white = white_noise_model(fit.residual[0], data.kept, system)
        others = [Term(term.effect, term.place, values) for values in chosen(fit, white)]
        starts = [candidate.with_terms((*candidate.terms[:-1], other)) for other in others]
        layout = Layout(context.simulator.setup, candidate)
        most = Equations(context.simulator, context.data, white, layout).cost(candidate)
        if len(starts) > CARRIED_ON:
            first = ends(starts, white, most, max_steps=FIRST_STEPS)
            starts = [end.candidate for end, _ in first[:CARRIED_ON]]
        best = next(iter(ends(starts, white, most)), (fit, noise_model))
        if not best[1].cost < noise_model.cost - worth:
            break
        fit, noise_model = best
    return fit


def products_of(
    context: SearchContext, candidate: Candidate, noise_model: NoiseModel, rows: Callable[[np.ndarray], np.ndarray]
) -> tuple[Products, np.ndarray]:
    """What other values of a candidate's last term would explain without it, M, D, K free to first order.

    **Arguments:** `context`; `candidate`; `noise_model` to whiten by; `rows`: from the values that the law itself
    begins with to those to score.

    **Returns:** the products of their responses, one for every row, and the rows.
    """
    data, (inputs, outputs) = context.data[0], context.names
    term = candidate.terms[-1]
    stage = stage_of_candidate(context, candidate.with_terms(candidate.terms[:-1]))
    whole = stage_of(context.simulator, candidate, data)
    hidden = context.simulator.setup.unmeasured
    scales = scales_at(stage.plant, whole.motion, data, inputs, outputs, lines_of(stage.e, data), hidden)
    key = "input" if term.effect.places == "input" else "coordinate", term.place.name
    tried = rows(np.array(term.effect.shapes(scales[key]), dtype=float))
    made = features(
        stage.plant,
        whole.motion,
        data,
        (term.effect,),
        scales,
        inputs,
        outputs,
        shapes={(term.effect.id, term.place.name): list(tried)},
        hidden=hidden,
        run=run_about(stage, data),
    )
    responses = as_answered(stage, made, data).responses
    return Products(noise_model, stage.e, stage.J, responses, data.kept), tried
