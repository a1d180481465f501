"""When something changed at once: how a refit finds the moment of a jump."""

import numpy as np

from ..mechanics.effects.base import AbstractOutputEffect, Scales, Term
from .bench import Bench
from .equations import weighted
from .problem import Candidate
from .residual import Chain


def softened(term: Term, scales: Scales) -> list[Term]:
    """The terms to refit one after the other: a sudden change first smeared over the distance between the times that
    were tried, since only the samples inside its edge can tell where it belongs."""
    names = [p.name for p in term.effect.parameters]
    if "width" not in names or len(scales.times) < 2:
        return [term]
    spacing = scales.times[1] - scales.times[0]
    result = []
    for width in (2 * spacing, spacing / 2, spacing / 8, scales.sampling_time):
        values = np.array(term.values, float)
        values[names.index("width")] = width
        result.append(Term(term.effect, term.place, values))
    return result


def width_of(term: Term) -> float:
    """Over how long [s] the jump of a term is smeared, 0 where there is none."""
    names = [p.name for p in term.effect.parameters]
    return float(term.values[names.index("width")]) if "width" in names else 0.0


def dated(bench: Bench, candidate: Candidate, chain: Chain, span: float) -> Candidate:
    """A candidate with the jump of its last term at the moment that leaves the least of the first record.

    While nothing moves, no gradient leads there. Only jumps of the outputs, whose free run costs next to nothing; other
    candidates come back as they are.

    **Arguments:** `bench`; `candidate`; `chain` by which the residual is whitened; `span` [s]: how far from where it is
    the moment is looked for, in steps of half of the term's width or a sample.

    **Returns:** a `Candidate`; nothing but the moment differs.
    """
    term = candidate.terms[-1]
    names = [p.name for p in term.effect.parameters]
    if not isinstance(term.effect, AbstractOutputEffect) or not {"t0", "width"} <= set(names):
        return candidate
    data, at = bench.data[0], names.index("t0")
    step = max(width_of(term) / 2, data.sampling_time)
    count = int(span / step)
    end = data.samples * data.sampling_time
    times = np.clip(float(term.values[at]) + step * np.arange(-count, count + 1), 0.0, end)
    found = []
    for time in times:
        values = np.array(term.values, float)
        values[at] = time
        found.append(candidate.with_terms((*candidate.terms[:-1], Term(term.effect, term.place, values))))
    left = [np.where(data.kept, data.y - bench.simulator.run(one, data), 0.0) for one in found]
    costs = np.sum(weighted(chain, np.stack(left, axis=2), data.kept) ** 2, axis=0)
    return found[int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))]
