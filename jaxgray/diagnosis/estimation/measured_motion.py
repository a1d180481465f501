"""Starts along the measured motion: a law's force as a known series, M, D, K and the first state refitted beside it.

Where M, D, K of the linear model have absorbed a law, the free runs with these M, D, K, without the law and with it,
are both far from the record, and the cost has many local maxima on the way to the optimum. The force that the law makes
along the measured motion has no such hills: with it as an input the free run is linear, and M, D, K give back what they
took.
"""

import dataclasses

import numpy as np

from ...mechanics.effects import CATALOGUE
from ...mechanics.effects.base import AbstractForceEffect, Parameter, Term
from ..model.candidate import Candidate
from ..noise.whitening import white_noise_model
from ..screening.features import forces_of
from ..screening.linearization import Stage, measured_motion
from ..screening.score_test import Score
from .context import SearchContext
from .gauss_newton import refit

STEPS = 15
"""Of each of the two refits."""


class KnownForce(AbstractForceEffect):
    """A force that is known over time but for its size: the scheduling channel."""

    id = "known_force"
    family = "start"
    law = "f = b·p(t)"
    parameters = (Parameter("b", (1, 0, 0), amplitude=True),)
    signature = "none: a start of refits"
    reference = ""
    places = "spring"

    def shapes(self, scales):
        return [np.ones(1)]

    def force(self, p, here, z):
        return p[0] * here.p


FORCES = (*(effect for effect in CATALOGUE if isinstance(effect, AbstractForceEffect)), KnownForce())
"""Force laws that a simulator of candidates is compiled with."""


def along_measured_motion(context: SearchContext, stage: Stage, score: Score, *, tolerance: float) -> Candidate | None:
    """Where a refit of a law may begin: refitted under white noise from M, D, K, first state and size of a refit with
    its force along the measured motion.

    **Arguments:** `context`; `stage`: without the law; `score`: of the law at its place, with the shape to begin from;
    `tolerance`: of the refits.

    **Returns:** a `Candidate`; None for laws that are no force on the motion or begin at once, where several records
    are fitted or a law reads the scheduling channel, or where nothing can be simulated.
    """
    term = score.shape.term(score.weights)
    on_motion = isinstance(term.effect, AbstractForceEffect) and term.effect.places != "input" and not term.effect.onset
    scheduled = any(t.effect.scheduled for t in (*context.simulator.completed(stage.candidate).terms, term))
    if not on_motion or scheduled or len(context.data) > 1:
        return None
    data = context.data[0]
    shape = dataclasses.replace(score.shape, values=term.values, basis=(term.values,))
    series = np.asarray(forces_of([shape], stage.plant, measured_motion(stage, data), data)[0])
    if not np.all(np.isfinite(series)):
        return None
    white = white_noise_model(stage.e, data.kept, stage.system)
    options = {"held": context.held, "max_steps": STEPS, "tolerance": tolerance}
    known = Term(KnownForce(), term.place, np.ones(1))
    begin = stage.candidate.with_terms((*stage.candidate.terms, known))
    simulator = context.simulator.in_first_steps(stage.plant, data)
    fit = refit(simulator, begin, [dataclasses.replace(data, scheduling=series)], white, **options)
    if fit is None:
        return None
    share = float(fit.candidate.terms[-1].values[0])
    sizes = np.array([parameter.amplitude for parameter in term.effect.parameters])
    values = term.effect.bounded(np.where(sizes, share * np.asarray(term.values), term.values))
    begin = fit.candidate.with_terms((*stage.candidate.terms, Term(term.effect, term.place, values)))
    fit = refit(simulator, begin, context.data, white, **options)
    return None if fit is None else fit.candidate
