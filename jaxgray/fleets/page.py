"""The population as one page: how records came out, which effects where, spreads, outliers, trends, every record."""

from collections import Counter
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ..diagnosis.words.titles import title_of
from ..numerics.text import plus_minus
from ..report.page.parts import Fact, Page, Plot, Section, Table, Words, axis
from ..report.rows import Rows, number
from .population import FALSE_DISCOVERIES, FAR_OUT, FEWEST, all_parameters, outliers, trends, values_of

MOST_ROWS = 1000
"""Records in the page's table; the file of the table has all of them."""

MOST_PLOTS = 24
"""Parameters of which a distribution is drawn."""

BINS = 30

WORDS = {
    "identified": "identified",
    "named": "cause named",
    "equivalent": "causes that look alike",
    "partly": "partly explained",
    "unexplained": "unexplained",
    "noise": "nothing missing",
    "failed": "failed",
}


def population_page(rows: list[dict], task: str, drift: tuple[Section, ...] = ()) -> Page:
    """The page of a fleet.

    **Arguments:** `rows`: one a record, as in the table; `task`; `drift`: sections on machines over time.

    **Returns:** a `Page`, with links to the pages of the records.
    """
    outcomes = Counter(row["outcome"] for row in rows)
    failed = [row for row in rows if row["outcome"] == "failed"]
    effects = Counter((row["effect"], row["place"]) for row in rows if row["effect"])
    far = outliers(rows)
    sections = (
        _effects(effects, rows),
        *drift,
        _distributions(rows),
        _outliers(far),
        _trends(rows),
        _failures(failed),
        _records(rows, far),
    )
    told = [f"{count} {WORDS.get(outcome, outcome)}" for outcome, count in outcomes.most_common()]
    machines = {row["machine"] for row in rows if row["machine"]}
    facts = [Fact("Records", str(len(rows)), f"of {len(machines)} machines" if machines else "")]
    facts += [Fact(WORDS.get(outcome, outcome).capitalize(), str(count)) for outcome, count in outcomes.most_common()]
    document = {
        "schema": "jaxgray/fleet-page/1",
        "task": task,
        "outcomes": dict(outcomes),
        "effects": [{"effect": e, "place": p, "records": count} for (e, p), count in effects.most_common()],
        "outliers": [
            {"file": one.row["file"], "parameter": one.parameter, "value": one.value, "distance": one.distance}
            for one in far[:MOST_ROWS]
        ],
        "failures": {row["file"]: row["failure"] for row in failed[:MOST_ROWS]},
    }
    return Page(
        "Fleet",
        "fleet",
        f"{len(rows)} records",
        f"{len(rows)} records: {', '.join(told)}.",
        (tuple(facts),),
        tuple(section for section in sections if section is not None and section.blocks),
        document,
    )


def _link(row: dict):
    name = Path(row["file"]).name
    return Markup('<a href="{}">{}</a>').format(row["page"], name) if row["page"] else name


def _effects(effects: Counter, rows: list[dict]) -> Section | None:
    if not effects:
        return None
    ordered = effects.most_common(40)[::-1]
    labels = [title_of(effect, place) for (effect, place), _ in ordered]
    bars = {
        "type": "bar",
        "orientation": "h",
        "x": [count for _, count in ordered],
        "y": labels,
        "marker": {"color": "@after"},
        "name": "records",
        "hovertemplate": "%{x} records",
    }
    layout = {"xaxis": axis("records"), "yaxis": {"type": "category", "automargin": True}, "showlegend": False}
    alt = "Records by the first effect found in them; the numbers are in the table."
    body = []
    for (effect, place), count in effects.most_common():
        of = [row for row in rows if (row["effect"], row["place"]) == (effect, place)]
        gains = [row["gain_percent"] for row in of if row.get("gain_percent") is not None]
        gain = f"{np.median(gains):.1f} %" if gains else "–"
        first = of[0] if count <= 3 else None
        shown = Markup(", ").join(_link(row) for row in of[:3]) + ("" if first else f" and {count - 3} more")
        body.append((title_of(effect, place), str(count), gain, shown))
    head = "effect", "records", "median error taken off", "in"
    table = Table(Rows(head, tuple(body), frozenset({0, 3})), "Effects and places")
    plot = Plot("effects", [bars], layout, 90 + 26 * len(ordered), alt)
    lead = "The first finding of every record that has one; records without are not counted."
    return Section("effects", "Which effects, where", lead, (plot, table))


def _distributions(rows: list[dict]) -> Section:
    plots, body = [], []
    for name in all_parameters(rows):
        x = values_of(rows, name)
        x, error = x[np.isfinite(x)], values_of(rows, f"{name}_error")
        if not len(x):
            continue
        low, middle, high = np.percentile(x, [2.5, 50, 97.5])
        error = error[np.isfinite(error)]
        own = f"{np.median(error):.2g}" if len(error) else "–"
        spread = f"{np.std(x, ddof=1):.3g}" if len(x) > 1 else "–"
        body.append((_titled(name), str(len(x)), f"{middle:.5g}", spread, own, f"{low:.5g} to {high:.5g}"))
        if len(plots) < MOST_PLOTS and len(x) >= FEWEST and np.ptp(x) > 0:
            plots.append(_histogram(name, x))
    head = "parameter", "records", "median", "standard deviation", "median standard error", "95 % of the records"
    table = Table(Rows(head, tuple(body)), "Spread of the parameters")
    lead = (
        "How mass, damping, stiffness, frequencies and damping ratios spread over the fleet. Where the spread is near "
        "the standard error, the machines do not differ."
    )
    return Section("distributions", "Distributions", lead, (table, *plots) if body else ())


def _titled(name: str) -> str:
    return name.replace("_hz", " [Hz]").replace("_", " ")


def _histogram(name: str, x: np.ndarray) -> Plot:
    # The few that lie far out would leave the others one bin.
    middle = np.median(x)
    reach = max(6 * 1.4826 * np.median(np.abs(x - middle)), 1e-9 * abs(middle))
    inside = x[np.abs(x - middle) <= reach] if np.median(np.abs(x - middle)) > 0 else x
    counts, edges = np.histogram(inside, bins=min(BINS, max(5, len(inside) // 4)))
    bars = {
        "type": "bar",
        "x": ((edges[1:] + edges[:-1]) / 2).tolist(),
        "y": counts.tolist(),
        "width": (edges[1] - edges[0]) * 0.92,
        "marker": {"color": "@after"},
        "name": "records",
        "hovertemplate": "%{x:.5~g}: %{y} records",
    }
    layout = {"xaxis": axis(_titled(name)), "yaxis": axis("records"), "showlegend": False, "hovermode": "closest"}
    beyond = len(x) - len(inside)
    caption = f"{beyond} {'record lies' if beyond == 1 else 'records lie'} beyond." if beyond else ""
    alt = f"Distribution of {_titled(name)}: median {middle:.5g}."
    return Plot(f"spread-{name}", [bars], layout, 210, alt, caption, width="third")


def _outliers(far: list) -> Section:
    lead = (
        f"Values more than {FAR_OUT:g} standard deviations from the median of the fleet, by its robust spread or the "
        "record's own standard error, whichever is larger."
    )
    if not far:
        return Section("outliers", "Outliers", lead, (Words(("None.",)),))
    body = tuple(
        (_link(one.row), _titled(one.parameter), f"{one.value:.5g}", f"{one.median:.5g}", f"{one.distance:+.1f}")
        for one in far[:100]
    )
    head = "record", "parameter", "value", "median of the fleet", "standard deviations"
    return Section("outliers", "Outliers", lead, (Table(Rows(head, body, frozenset({0, 1})), "Farthest first"),))


def _trends(rows: list[dict]) -> Section:
    when = values_of(rows, "when_number")
    known = np.isfinite(when).sum() > 1
    names = [name for name in all_parameters(rows) if name.startswith(("frequency", "stiffness"))]
    plots = []
    x, title = (when, "when") if known else (np.arange(len(rows)) + 1.0, "record")
    for name in [name for name in names if name.startswith("frequency") or name.count("_") == 1][:8]:
        y = values_of(rows, name)
        seen = np.isfinite(y) & np.isfinite(x)
        if seen.sum() < 2:
            continue
        marks = {"mode": "markers", "marker": {"color": "@after", "size": 4}, "name": _titled(name)}
        trace = {"x": x[seen].tolist(), "y": y[seen].tolist(), **marks}
        layout = {"xaxis": axis(title), "yaxis": axis(_titled(name)), "showlegend": False, "hovermode": "closest"}
        alt = f"{_titled(name)} of every record over {title}."
        plots.append(Plot(f"trend-{name}", [trace], layout, 230, alt, width="half"))
    lead = "Values over the order of the files; nothing says when they were made, so no trend is tested."
    blocks = tuple(plots)
    if known:
        found = trends(rows)
        lead = (
            "Parameters that rise or fall over time by Kendall's test, with Theil's slope; at most "
            f"{100 * FALSE_DISCOVERIES:g} % of them are expected to be false."
        )
        body = tuple(
            (
                _titled(one.parameter),
                f"{one.slope:.3g}",
                f"{one.interval[0]:.3g} to {one.interval[1]:.3g}",
                f"{one.probability:.1e}",
            )
            for one in found
        )
        head = "parameter", "slope per unit of time", "95 % interval", "probability by chance"
        table = Table(Rows(head, body), "Trends") if body else Words(("No parameter has a trend.",))
        blocks = (table, *plots)
    return Section("trends", "Trends", lead, blocks)


def _failures(failed: list[dict]) -> Section | None:
    if not failed:
        return None
    body = tuple((Path(row["file"]).name, row["failure_kind"], row["failure"]) for row in failed[:MOST_ROWS])
    table = Table(Rows(("record", "kind", "reason"), body, frozenset({0, 1, 2})), "Records without an answer")
    return Section("failures", "Failed records", "Each with its reason; all other records are unaffected.", (table,))


def _records(rows: list[dict], far: list) -> Section:
    """The records that stand out first: failed, with effects, outliers; then the others."""
    out = {one.row["file"] for one in far}
    ordered = sorted(rows, key=lambda row: (row["outcome"] != "failed", not row["effect"], row["file"] not in out))
    frequencies = [name for name in all_parameters(rows) if name.startswith("frequency")][:3]
    fits = [name for name in dict.fromkeys(n for row in rows for n in row) if name.startswith("fit_percent")][:2]
    body = []
    for row in ordered[:MOST_ROWS]:
        cells = [_link(row), WORDS.get(row["outcome"], row["outcome"])]
        cells.append(title_of(row["effect"], row["place"]) if row["effect"] else "–")
        cells += [
            "–" if row.get(name) is None else plus_minus(row[name], row.get(f"{name}_error")) for name in frequencies
        ]
        cells += [number(row.get(name), "{:.2f} %") for name in fits]
        cells.append(number(row.get("excess"), "{:.2f}"))
        body.append(tuple(cells))
    head = ("record", "outcome", "effect", *map(_titled, frequencies), *map(_titled, fits), "error over noise floor")
    left = len(rows) - len(body)
    lead = "Failed records, those with effects and outliers first."
    if left:
        lead += f" {left} more are in results.parquet."
    table = Table(Rows(head, tuple(body), frozenset({0, 1, 2})), "Records", folded=len(body) > 40)
    return Section("records", "Every record", lead, (table,))
