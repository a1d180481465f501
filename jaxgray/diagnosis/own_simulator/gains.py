"""Runs of the simulator over the data of the fit and those held out, and what one gains over another."""

import numpy as np

from ..estimation.context import SearchContext
from ..findings import Gain
from ..model.free_run import FreeRun, rms_of
from ..model.held_out_gain import gain_of
from .problem import Problem

Outputs = tuple[np.ndarray, ...]
"""What the sensors show of runs of all spans."""

Parts = tuple[list[FreeRun], list[FreeRun]]
"""Runs over the data of the fit, and over those held out."""


def parts_of(problem: Problem, y: Outputs) -> Parts:
    """Runs of the whole records as runs of their parts."""
    pairs = list(zip(problem.spans, y))
    fit = [span.run(one, span.fit) for span, one in pairs if span.fit is not None]
    return fit, [span.run(one, span.held) for span, one in pairs if span.held is not None]


def gain_between(
    problem: Problem,
    context: SearchContext,
    before: Outputs,
    after: Outputs,
    baseline: Outputs,
    floor: np.ndarray | None = None,
    local: bool = False,
) -> Gain:
    """Gain from some runs to others, on held-out data where there are such.

    **Arguments:** `problem`; `context`; the runs, and those with the numbers as they were given; `floor`: noise per
    output, default what is left after; `local`: of a law that no other record shows.
    """
    every = [parts_of(problem, y) for y in (before, after, baseline)]
    held_out = bool(every[0][1]) and not local
    floor = rms_of(every[1][0]) if floor is None else floor
    runs, seen = (tuple(parts[k] for parts in every) for k in (held_out, False))
    return gain_of(*runs, floor, problem.record.output_names, held_out=held_out, rng=context.rng, seen=seen)


def nearer(problem: Problem, one: Outputs, other: Outputs) -> Outputs:
    """The runs that leave less of held-out data, or of those of the fit where there are no others."""

    def left(y: Outputs) -> float:
        fit, held = parts_of(problem, y)
        return float(np.sum(np.log(rms_of(held or fit))))

    return one if left(one) <= left(other) else other
