"""Laws begun from other linear models of the record than the best one.

A missing law distorts a fitted linear model until its free run is as near as it can be, and where its structure is
known that may be far from the truth: a mass that nothing measures becomes very large, or zero. A model whose transfer
function agrees with some realisation of the record is farther off in its free run and nearer in its numbers. Laws are
looked for about it as about the best one, and all refits are compared with each other.
"""

from ..estimation.context import SearchContext, stage_of_candidate
from ..estimation.multistart import Attempt, attempts_of
from ..noise.whitening import white_noise_model
from ..screening.linearization import Stage, screen_simulated, screen_smoothed
from ..screening.shortlist import shortlist


def from_other_models(context: SearchContext, stage: Stage) -> list[Attempt]:
    """The most promising laws about every other linear model, refitted; none where there is no other, or a law is in
    the model already.

    **Arguments:** `context`; `stage`: the best linear model.
    """
    found: list[Attempt] = []
    for candidate in () if stage.candidate.terms or context.others is None else context.others():
        context.progress.stage("looking from another linear model")
        other, data = stage_of_candidate(context, candidate), context.data[0]
        looked = other, data, context.catalogue, context.names
        screening, closer = screen_simulated(*looked, surrogates=0), screen_smoothed(*looked)
        white = white_noise_model(other.e, data.kept, other.system)
        found += attempts_of(context, other, shortlist(screening, closer), white, [], {}).values()
    return found
