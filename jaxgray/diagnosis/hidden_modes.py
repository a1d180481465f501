"""Modes that the gate does not hear: what one leaves is coloured, and the chain takes that for colour of the noise.

To first order a mass on a spring moves the poles of the structure, which no score tells well; and its residual rings at
one frequency, as an autoregression does. So where nothing else explains a record, a mode that would explain some of the
residual taken as white is refitted and judged by what it is worth then.
"""

from ..mechanics.effects.disturbance import PeriodicDisturbance
from .bench import Bench, chain_of
from .credit import CLEAR
from .judgement import ACCEPTED
from .pursuit import pursued
from .refitting import Attempt, compared, first_fit
from .residual import white_chain
from .screening import Score, Screening
from .shortlist import adds_mode, at_lines
from .stage import Stage


def hidden_modes(bench: Bench, stage: Stage, screening: Screening, tried: frozenset = frozenset()) -> list[Attempt]:
    """Effects that add a mode, refitted from where they would explain most of the residual taken as white, best first.

    **Arguments:** `bench`; `stage`; `screening`: of that stage; `tried`: effects and places that were refitted already.
    Where the gate fires or the residual rings, every place is tried, otherwise those where a mode would explain
    something.
    """
    line = next((score for score in screening.first if score.shape.effect.id == PeriodicDisturbance.id), None)
    anywhere = screening.fires or (line is not None and line.delta_bic > CLEAR)
    listed: dict[tuple[str, str], Score] = {}
    for score in screening.first:
        effect, name = score.shape.effect, (score.shape.effect.id, score.shape.place.name)
        if adds_mode(effect) and (anywhere or score.delta_bic >= ACCEPTED) and name not in tried:
            listed.setdefault(name, score)
    attempts = []
    chain = white_chain(stage.e, bench.data[0].kept, stage.system)
    for (effect, place), score in listed.items():
        bench.progress.stage(f"refitting {effect} at {place}")
        fits = [first_fit(bench, stage, start, chain, float("inf")) for start in (score, *at_lines(score))]
        best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.cost, default=None)
        if best is not None:
            end = pursued(bench, best)
            attempts.append(Attempt(score, end, chain_of(bench, end)))
    return compared(bench, stage, attempts)
