"""Findings on the raw record, before any model."""

import weakref
from collections.abc import Callable, Iterator

from jaxgray.records.checks import channel_checks, relation_checks
from jaxgray.records.checks.finding import SEVERITIES, RecordFinding
from jaxgray.records.checks.looked import Looked
from jaxgray.records.joining import record_of
from jaxgray.records.record import Record

# A new finding is one function and one row here; those of channels beside one another stand in the order in which one
# defect hides another.
Checks = tuple[Callable[[Looked], Iterator[RecordFinding]], ...]
CHANNELS: Checks = (
    channel_checks.too_short,
    channel_checks.constant,
    channel_checks.doubled,
    channel_checks.missing,
    channel_checks.frozen,
    channel_checks.clipping,
    channel_checks.quantization,
    channel_checks.outliers,
)
RELATIONS: Checks = (
    relation_checks.excitation,
    relation_checks.drift,
    relation_checks.unit,
    relation_checks.exchange,
    relation_checks.timing,
    relation_checks.no_answer,
    relation_checks.loop,
    relation_checks.signs,
    relation_checks.alias,
    relation_checks.hum,
)


def preflight(record: Record, *, relations: bool = True) -> list[RecordFinding]:
    """Look at a record before any model: sensors, channels, units, signs, timing and excitation.

    Channels are looked at one by one, then how the outputs follow the inputs by a long difference equation. Inputs are
    not looked at for limits: steps and binary sequences rest at their extremes by design.

    **Arguments:**

    - `record`: the `Record` as measured.
    - `relations`: whether channels are looked at beside one another as well, which takes most of the time; default
        True. Never where rows lie more than half a step from a uniform grid.

    **Returns:** the `RecordFinding`s, worst first; empty for a clean record.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> jaxgray.preflight(record)
        []
        >>> clipped = jaxgray.Record(u, np.minimum(y, np.quantile(y, 0.8)), 0.01)
        >>> [finding.effect for finding in jaxgray.preflight(clipped)]
        ['sensor_clipping']
    """
    record = record_of(record, "record")
    # Asked at every stage of a diagnosis.
    relations = relations and (record.stamps is None or record.stamps.jitter <= NEAR)
    known = _seen.setdefault(record, {})
    if relations not in known:
        looked = Looked(record)
        findings = [found for check in CHANNELS + RELATIONS * relations for found in check(looked)]
        known[relations] = sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity))
    return list(known[relations])


NEAR = 0.5
"""Distance of rows from a uniform grid, in its steps, up to which channels are looked at beside one another: with 0.3
steps, 120 clean records gave one false finding, as many as without."""

_seen: weakref.WeakKeyDictionary[Record, dict[bool, list[RecordFinding]]] = weakref.WeakKeyDictionary()
