"""How many coordinates no output measures: one more as long as the record asks for it, and held-out data agree."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.progress import AbstractProgress
from ...records import Record
from ..hidden import HiddenEvidence, OrderEvidence, OrderStep, canonical_gauge
from ..result import Identification
from ..validation.structure_test import coloured_cost
from .identify import identify_hidden
from .request import HiddenRequest

MIN_DELTA_BIC = 10.0
"""Fall of BIC that one more hidden coordinate must bring."""

SURE = 2.6
"""Standard errors by which the squared error on held-out data must fall: 99 %."""

MOST = 3
"""Hidden coordinates that are tried at most."""

HELD_OUT = 0.3
"""Share of a record that is held out where no validation record is given."""

BLOCKS = 24
"""Blocks of the held-out data between which the gain is compared with its spread."""


def identify_auto(
    records: list[Record],
    held_out: list[Record],
    request: HiddenRequest,
    notes: list[str],
    without: Callable[..., Identification],
    progress: AbstractProgress,
) -> Identification:
    """The model with as many hidden coordinates as the record asks for.

    One more is accepted where BIC falls by more than `MIN_DELTA_BIC`, the colour of the residual allowed for, and the
    error on held-out data falls for sure.

    **Arguments:** as of `identify_hidden`; `without`: identifies a model without hidden coordinates.

    **Returns:** an `Identification`, refined on all records, with the evidence for its order.

    **Raises:** `ValueError` where connections are named, which say the number themselves.
    """
    if request.structure:
        raise ValueError("hidden='auto' finds the number of coordinates, which connections name; give one of the two.")
    seen, unseen = (records, held_out) if held_out else _split(records)

    def fitted(count: int, given: list[Record], kept: list[Record]) -> Identification:
        if count:
            return identify_hidden(given, kept, request.named(count, records[0].output_names), list(notes), progress)
        return without(
            given,
            validation=kept or None,
            refine=request.refine,
            time_constants=request.time_constants,
            block_rows=request.block_rows,
            weight=request.weight,
            map=request.map,
            excitation=request.excitation,
            input_map=request.input_map,
            relative=request.relative,
            fix=request.fix,
            noise=request.noise,
        )

    steps, best, chosen, values = [], None, 0, None
    for count in range(MOST + 1):
        progress.stage(f"{count} hidden coordinates")
        try:
            here = fitted(count, seen, unseen)
        except ComputationError as error:
            steps.append(OrderStep(count, None, None, None, False, str(error).rstrip(".")))
            if count > chosen + 1:
                break
            continue
        values = here.start.singular_values if here.start.singular_values is not None else values
        if best is None:
            steps.append(OrderStep(count, None, None, None, True))
            best, chosen = here, count
            continue
        delta = float(coloured_bic(here) - coloured_bic(best))
        gain, error = held_out_gain(here, best)
        accepted = bool(delta < -MIN_DELTA_BIC and gain > SURE * error)
        steps.append(OrderStep(count, delta, 100 * gain, 100 * error, accepted))
        if not accepted:
            # Two that gain only together: once more, unless there is nothing left to gain.
            if count > chosen + 1 or not delta < 0:
                break
            continue
        best, chosen = here, count
    if best is None:
        raise ComputationError(RESULTS.order_not_found, stage="order", detail=steps[-1].failure or "no model was found")
    order = OrderEvidence(tuple(steps), values)
    result = fitted(chosen, records, held_out) if seen is not records else best
    if result.hidden is None:
        none = dict(zip(("mass", "damping", "stiffness"), canonical_gauge(result.model.dofs, 0)))
        count = 3 * result.model.dofs * (result.model.dofs + 1) // 2
        return replace(result, hidden=HiddenEvidence((), True, none, dict(none), (), count, count, (), (), order))
    return replace(result, hidden=replace(result.hidden, order=order))


def _split(records: list[Record]) -> tuple[list[Record], list[Record]]:
    pairs = [record.split(HELD_OUT) for record in records]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def coloured_bic(result: Identification) -> float:
    """BIC of a model under the colour that its own residual has: what only the colour of noise gains does not count."""
    total, count = 0.0, 0
    for k in range(result.model.outputs):
        e = np.concatenate([fit.residual[np.isfinite(fit.residual[:, k]), k] for fit in result.estimation])
        total += coloured_cost(e)
        count += len(e)
    if result.refinement is None:
        free = 3 * result.model.dofs * (result.model.dofs + 1) // 2
    else:
        free = result.refinement.normal.information.shape[0] - int(np.sum(result.fixed))
    return total + free * float(np.log(count))


def held_out_gain(end: Identification, start: Identification) -> tuple[float, float]:
    """Mean relative fall of the squared error on held-out data, and its standard error between blocks."""
    falls, lengths = [], []
    for new, old in zip(end.validation, start.validation):
        level = np.nanmean(old.residual**2, axis=0)
        fall = np.nanmean((old.residual**2 - new.residual**2) / np.maximum(level, 1e-300), axis=1)
        blocks = np.array_split(fall, max(BLOCKS // len(end.validation), 4))
        falls += [np.nanmean(block) for block in blocks]
        lengths += [len(block) for block in blocks]
    falls, lengths = np.asarray(falls), np.asarray(lengths)
    mean = float(np.average(falls, weights=lengths))
    spread = float(np.sqrt(np.sum(lengths**2 * (falls - mean) ** 2)) / np.sum(lengths))
    return mean, spread
