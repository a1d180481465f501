"""Changes of machines over time, on the page of the fleet and as JSON."""

import numpy as np

from ...report.page.parts import Plot, Section, Table, Words, axis
from ...report.rows import Rows
from .changes import curve
from .machines import RATE, Drift

MOST_PLOTS = 24


def drift_document(drifts: tuple[Drift, ...], not_compared: dict[str, str]) -> dict:
    """Changes as the JSON schema `jaxgray/drift/1`."""
    return {
        "schema": "jaxgray/drift/1",
        "false_discovery_rate": RATE,
        "drifts": [
            {
                "machine": one.machine,
                "name": one.name,
                "kind": one.change.kind,
                "since_record": one.change.begins + 1,
                "since_records_95": [k + 1 for k in one.change.interval],
                "since": one.when,
                "file": one.since,
                "size": one.change.size,
                "standard_error": one.change.standard_error,
                "relative": one.relative,
                "probability": one.probability,
                "alternatives": list(one.alternatives),
                "sentence": one.sentence,
            }
            for one in drifts
        ],
        "not_compared": not_compared,
    }


def drift_section(drifts: tuple[Drift, ...], not_compared: dict[str, str]) -> Section:
    """Table and plots of the changes."""
    lead = (
        "Each record against its machine's reference at the same conditions: which parameter has moved, since when, by "
        "how much, covariates taken out; and effects that began or grew. Over all machines and parameters at most "
        f"{100 * RATE:g} % of the alarms are expected to be false."
    )
    blocks: list = [Words(tuple(one.sentence for one in drifts) or ("No machine has changed beyond its error bars.",))]
    if drifts:
        body = tuple(_row(one) for one in drifts)
        head = "machine", "what", "how", "since record", "95 %", "since", "size", "relative", "by chance", "or"
        blocks.append(Table(Rows(head, body, frozenset({0, 1, 2, 5, 9})), "Changes"))
        blocks += [_plot(k, one) for k, one in enumerate(drifts[:MOST_PLOTS])]
    if not_compared:
        body = tuple(not_compared.items())
        blocks.append(Table(Rows(("machine", "why"), body, frozenset({0, 1})), "Machines not compared", True))
    return Section("drift", "Machines over time", lead, tuple(blocks))


def _row(one: Drift) -> tuple[str, ...]:
    change = one.change
    first, last = change.interval
    chance = "< 1e-12" if one.probability < 1e-12 else f"{one.probability:.1e}"
    return (
        one.machine,
        one.title,
        {"step": "at once", "ramp": "gradually"}[change.kind],
        str(change.begins + 1),
        f"{first + 1} to {last + 1}",
        one.when,
        f"{change.size:.3g} ± {change.standard_error:.1g}",
        "–" if one.relative is None else f"{100 * one.relative:+.2f} %",
        chance,
        ", ".join(one.alternatives[:3]) or "–",
    )


def _plot(k: int, one: Drift) -> Plot:
    """Estimates over the records with 95 % bars, and the change that was found."""
    x = np.arange(1, len(one.estimates) + 1)
    shape = curve(one.change.kind, one.change.begins, len(x))
    line = one.change.size * shape / shape[-1]
    line = line + np.average(one.estimates - line, weights=1 / one.errors**2)
    bars = {"type": "data", "array": (1.96 * one.errors).tolist(), "color": "@faint", "thickness": 1, "width": 0}
    marks = {"mode": "markers", "marker": {"color": "@before", "size": 5}, "error_y": bars}
    traces = [
        {"x": x.tolist(), "y": one.estimates.tolist(), "name": "record ± 95 %", **marks},
        {
            "x": x.tolist(),
            "y": line.tolist(),
            "name": "change that was found",
            "mode": "lines",
            "line": {"color": "@after", "width": 2},
        },
    ]
    name = f"{one.title} off its reference" if one.relative is not None else one.title
    layout = {"xaxis": axis(f"record of {one.machine}"), "yaxis": axis(name), "hovermode": "closest"}
    return Plot(f"drift-{k}", traces, layout, 280, one.sentence, f"{one.machine}: {one.title}.", width="half")
