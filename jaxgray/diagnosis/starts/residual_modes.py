"""Modes that the gate does not hear: what one leaves is coloured, and the noise model takes that for colour of the
noise.

To first order a mass on a spring moves the poles of the structure, which no score tells well; and its residual rings at
one frequency, as an autoregression does. So where nothing else explains a record, a mode that would explain some of the
residual taken as white is refitted and judged by what it is worth then.
"""

from ...mechanics.effects.disturbance import PeriodicDisturbance
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import refit_to_convergence
from ..estimation.gauss_newton import Refit
from ..estimation.multistart import Attempt, compared, first_fit
from ..noise.whitening import white_noise_model
from ..screening.linearization import Stage
from ..screening.score_test import Score, Screening
from ..screening.shortlist import adds_mode, at_lines, begun_at


def hidden_modes(
    context: SearchContext, stage: Stage, screening: Screening, tried: frozenset = frozenset()
) -> list[Attempt]:
    """Effects that add a mode, refitted from where they would explain most of the residual taken as white, best first.

    **Arguments:** `context`; `stage`; `screening`: of that stage; `tried`: effects and places that were refitted
    already. Where the gate fires or the residual rings, every place is tried, otherwise those where a mode would
    explain something: the first of them from every line of the residual, the others from where that one ended.
    """
    line = next((score for score in screening.white if score.shape.effect.id == PeriodicDisturbance.id), None)
    anywhere = screening.fires or (line is not None and line.delta_bic > settings.CLEAR_DELTA_BIC)
    listed: dict[tuple[str, str], Score] = {}
    for score in screening.white:
        effect, name = score.shape.effect, (score.shape.effect.id, score.shape.place.name)
        if adds_mode(effect) and (anywhere or score.delta_bic >= settings.MIN_DELTA_BIC) and name not in tried:
            listed.setdefault(name, score)
    noise_model = white_noise_model(stage.e, context.data[0].kept, stage.system)
    best: dict[tuple[str, str], Refit] = {}

    def begun(one):
        (effect, place), start = one
        context.progress.stage(f"refitting {effect} at {place}")
        return first_fit(context, stage, start, noise_model, float("inf"))

    def begin(starts):
        for (name, _), fit in zip(starts, side_by_side(begun, starts)):
            if fit is not None and (name not in best or fit.cost < best[name].cost):
                best[name] = fit

    def ended(name):
        context.progress.stage(f"refining {name[0]} at {name[1]}")
        end = refit_to_convergence(context, best[name])
        return Attempt(listed[name], end, noise_model_of(context, end))

    for effect_id in dict.fromkeys(effect for effect, _ in listed):
        (name, score), *others = [item for item in listed.items() if item[0][0] == effect_id]
        begin([(name, start) for start in (score, *at_lines(score))])
        # A structure rings at the same frequency wherever the mass is, and little differs but how heavy it seems.
        found = [begun_at(other, best[name].candidate.terms[-1].values) for _, other in others if name in best]
        begin([*others, *((other, start) for (other, _), start in zip(others, found))])
    return compared(context, stage, side_by_side(ended, best))
