"""The plots of a diagnosis for its page: runs over time, spectra, missing forces, ranking, budget, the experiment."""

import numpy as np

from ...diagnosis.conclusions.missing_force import MissingForce, Variable, missing_forces
from ...diagnosis.conclusions.spectra import Spectra, spectra
from ...diagnosis.result import Diagnosis
from ...diagnosis.words.titles import title_of
from ..diagnosis_rows import budget_name, coordinate_names
from .binning import binned, decided_by
from .parts import Plot, axis, labelled, over_time, packed, stretch_for
from .time_plots import Channel, Run, closer, stretches, whole

OF_EACH = 4
"""Outputs up to which every one is shown closely; of more, the worst alone."""

MOST_LINES = 3000
"""Lines of a periodic record that are drawn at most, of each kind."""

NOUN = {"force": "missing force", "input": "missing input", "output": "missing output"}


def over_time_plots(diagnosis: Diagnosis) -> list[Plot]:
    """Measured, simulated and extended: the worst stretch, a typical one, and the whole record, output by output."""
    curves = next((c for c in diagnosis.curves if c.held_out), diagnosis.curves[0])
    model = diagnosis.baseline.model
    first = "your model" if diagnosis.own_model else "linear model"
    runs = [Run(first, "@before", curves.baseline)]
    if diagnosis.extended is not None:
        runs.append(Run("extended model", "@after", curves.extended))
    floors = [diagnosis.noise_floor.get(name) or np.nan for name in model.output_names]
    worst = np.nanargmax(np.nanmean((curves.measured - curves.baseline) ** 2, axis=0) / np.square(floors))
    plots = []
    series = model.dofs * (1 + 2 * len(runs))
    for k, (name, unit) in enumerate(zip(model.output_names, model.output_units)):
        channel = Channel(k, name, unit, floors[k])
        near = whole(curves.time, curves.measured, runs, channel, name=f"time-{k}", series=series)
        if model.dofs <= OF_EACH or k == worst:
            for word, window in zip(("Worst", "Typical"), stretches((curves.measured - curves.baseline)[:, k])):
                label = f"{word} stretch"
                name = f"time-{k}-{word.lower()}"
                args = curves.time, curves.measured, runs, channel, window
                plots.append(closer(*args, name=name, title=label))
        plots.append(near)
    return plots


def spectrum_plots(diagnosis: Diagnosis) -> list[Plot]:
    """Spectra of the output and of the errors before and after, beside the noise floor."""
    made, model = spectra(diagnosis), diagnosis.baseline.model
    first = "error of your model" if diagnosis.own_model else "error of linear model"
    parts = [("measured", "@measured", made.measured), (first, "@before", made.before)]
    if diagnosis.extended is not None:
        parts.append(("error of extended model", "@after", made.after))
    plots = []
    for k, (name, unit) in enumerate(zip(model.output_names, model.output_units)):
        traces = []
        for label, colour, values in parts:
            traces += _spectrum(made, label, colour, values[:, k])
        ends = [float(made.frequency_hz[0]) * (1.0 if made.period is None else 0.85), float(made.frequency_hz[-1])]
        level = float(made.floor[k])
        if np.isfinite(level):
            dashed = {"color": "@text", "width": 1.5, "dash": "dash"}
            traces.append({"x": ends, "y": [level] * 2, "name": "noise floor", "mode": "lines", "line": dashed})
        density = unit and (unit if made.period else f"{unit}/√Hz")
        layout = {
            "xaxis": axis("frequency [Hz]", type="log", range=np.log10(ends).tolist()),
            "yaxis": axis(labelled("amplitude" if made.period else "amplitude density", density), type="log"),
            "hovermode": "x",
        }
        alt = f"Spectrum of {name}: measured, errors before and after the extension, and the noise floor."
        half = model.dofs > 1
        plots.append(
            Plot(
                f"spectrum-{k}",
                traces,
                layout,
                340,
                alt,
                f"Output {name}.",
                linked="frequency",
                width="half" if half else "",
            )
        )
    return plots


def _spectrum(made: Spectra, label: str, colour: str, values) -> list[dict]:
    """One line; of a periodic record, marks for the lines that are driven, and those that are not, odd and even."""
    if made.driven is None:
        line = {"mode": "lines", "line": {"color": colour, "width": 1.4}}
        return [{"x": packed(made.frequency_hz), "y": packed(values), "name": label, **line}]
    number = np.arange(1, len(values) + 1)
    groups = [("driven lines", made.driven, "circle")]
    if label != "measured":
        quiet = ~made.driven
        groups += [
            ("odd lines", quiet & (number % 2 == 1), "x-thin"),
            ("even lines", quiet & (number % 2 == 0), "square-open"),
        ]
    traces = []
    for word, chosen, symbol in groups:
        if chosen.any():
            # Of very many lines, every so many: a few thousand marks are all that a plot can show.
            chosen = np.flatnonzero(chosen)
            chosen = chosen[:: -(-len(chosen) // MOST_LINES)]
            marks = {"mode": "markers", "marker": {"color": colour, "size": 4, "symbol": symbol}}
            if symbol == "x-thin":
                marks["marker"] |= {"line": {"color": colour, "width": 1.2}}
            points = {"x": packed(made.frequency_hz[chosen]), "y": packed(values[chosen])}
            traces.append({**points, "name": f"{label}, {word}", **marks})
    return traces


def missing_force_plots(diagnosis: Diagnosis) -> list[Plot]:
    """What the model lacks against displacement, velocity, time and input, with the law that was found."""
    names = diagnosis.baseline.model.coordinates
    plots = []
    for j, one in enumerate(missing_forces(diagnosis)):
        title = title_of(one.effect, one.location, names) if one.effect else f"what is left at {one.location}"
        for i, variable in enumerate(one.variables):
            plots.append(_against(one, variable, f"missing-{j}-{i}", title))
    return plots


def _against(one: MissingForce, variable: Variable, name: str, title: str) -> Plot:
    """One panel: samples; their means where the variable alone decides, and the law as a line there, else as points."""
    noun, x = NOUN[one.quantity], variable.values
    traces = [_points(x, one.missing, f"{noun}, measured", "@faint")]
    decides = one.law is None or (variable.name != "time" and decided_by(x, one.law))
    if one.law is not None and not decides:
        traces.append(_points(x, one.law, "law that was found", "@after"))
    if one.law is not None and decides:
        traces += _law(x, one)
    if decides:
        centre, mean, spread = binned(x, one.missing)
        bars = {"type": "data", "array": (2 * spread).tolist(), "color": "@before", "thickness": 1.2, "width": 2}
        marks = {"mode": "markers", "marker": {"color": "@before", "size": 5}, "error_y": bars}
        traces.append({"x": centre.tolist(), "y": mean.tolist(), "name": "mean ± 2 se", **marks})
    shown = np.quantile(one.missing, [0.005, 0.995])
    reach = shown + np.array([-0.25, 0.25]) * (shown[1] - shown[0])
    layout = {
        "xaxis": axis(labelled(variable.name, variable.unit)),
        "yaxis": axis(labelled(noun, one.unit), range=reach.tolist()),
        "hovermode": "closest",
    }
    alt = f"{title}: {noun} against {variable.name}" + (", with the law that was found." if one.effect else ".")
    return Plot(name, traces, layout, 300, alt, f"{title}: against {variable.name}.", width="half")


def _points(x, y, name: str, colour: str) -> dict:
    marker = {"color": colour, "size": 3}
    return {"x": packed(x), "y": packed(y), "mode": "markers", "hoverinfo": "skip", "name": name, "marker": marker}


def _law(x, one: MissingForce) -> list[dict]:
    """The law as a line with its band, where one is known."""
    at, law, _ = binned(x, one.law)
    traces = []
    if one.error is not None and np.any(one.error > 0):
        reach = 2 * binned(x, one.error)[1]
        outline = {"x": [*at, *at[::-1]], "y": [*(law + reach), *(law - reach)[::-1]], "mode": "lines"}
        style = {"fill": "toself", "fillcolor": "@afterband", "line": {"width": 0}, "hoverinfo": "skip"}
        traces.append({**outline, **style, "name": "law ± 2 se"})
    line = {"mode": "lines", "line": {"color": "@after", "width": 2.2}}
    return [*traces, {"x": at.tolist(), "y": law.tolist(), "name": "law that was found", **line}]


def ranking_plot(rows: list[dict], names: tuple[str, ...]) -> Plot | None:
    """ΔBIC of the candidates that were refitted, at the gate and after the refit; None where there are none."""
    known = [row for row in rows if (row["refit"] or 0) > 1 or (row["gate"] or 0) > 1][:15][::-1]
    if not known:
        return None
    labels = [title_of(row["effect"], row["location"], names) for row in known]
    traces = []
    for key, label, colour, symbol in (
        ("gate", "at the gate", "@before", "circle-open"),
        ("refit", "after the refit", "@after", "circle"),
    ):
        values = [row[key] if row[key] is not None and row[key] > 1 else None for row in known]
        if any(v is not None for v in values):
            marker = {"color": colour, "size": 10, "symbol": symbol, "line": {"color": colour, "width": 2}}
            traces.append({"x": values, "y": labels, "name": label, "mode": "markers", "marker": marker})
    layout = {
        "xaxis": axis("ΔBIC (counts from 10)", type="log"),
        "yaxis": {"type": "category", "automargin": True},
        "shapes": [
            {
                "type": "line",
                "x0": 10,
                "x1": 10,
                "yref": "paper",
                "y0": 0,
                "y1": 1,
                "line": {"color": "@text", "width": 1, "dash": "dot"},
            }
        ],
        "hovermode": "closest",
    }
    alt = "Candidates by the evidence for them, ΔBIC at the gate and after the refit; the numbers are in the table."
    return Plot("ranking", traces, layout, 120 + 26 * len(known), alt)


def budget_plot(document: dict) -> Plot:
    """Share of every term, noise and the unexplained in one bar."""
    names = coordinate_names(document)
    palette = ["@after", "@second", "@third", "@fourth"]
    traces = []
    for k, (key, share) in enumerate(document["budget"].items()):
        colour = {"noise": "@measured", "unexplained": "@before"}.get(key, palette[k % len(palette)])
        traces.append(
            {
                "type": "bar",
                "orientation": "h",
                "x": [share],
                "y": [""],
                "name": budget_name(key, names),
                "marker": {"color": colour},
                "hovertemplate": "%{x:.1f} %",
            }
        )
    layout = {
        "barmode": "relative",
        "xaxis": axis("share of mean square error [%]"),
        "yaxis": {"showticklabels": False, "fixedrange": True},
        "hovermode": "closest",
    }
    return Plot("budget", traces, layout, 170, "Shares of the error in one bar; the numbers are in the table.")


def experiment_plots(diagnosis: Diagnosis) -> list[Plot]:
    """The input that is proposed, channel by channel."""
    proposed, model = diagnosis.next_experiment, diagnosis.baseline.model
    u = np.asarray(proposed.input)
    time, plots = proposed.sampling_time * np.arange(len(u)), []
    for k, (name, unit) in enumerate(zip(model.input_names, model.input_units)):
        stretch = stretch_for(len(u), 8 * u.shape[1])
        line = {"mode": "lines", "line": {"color": "@after", "width": 1.2}, "name": name}
        layout = {"xaxis": axis("time [s]"), "yaxis": axis(labelled(name, unit)), "hovermode": "x", "showlegend": False}
        alt = f"Proposed input {name} over time."
        plots.append(
            Plot(
                f"experiment-{k}",
                [{**over_time(time, u[:, k], stretch), **line}],
                layout,
                230,
                alt,
                f"Input {name}.",
                linked="experiment",
            )
        )
    return plots
