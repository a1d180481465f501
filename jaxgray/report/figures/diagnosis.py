"""Figures of a diagnosis; every function returns the Matplotlib figure."""

import numpy as np
from matplotlib.figure import Figure

from ...diagnosis.conclusions.missing_force import missing_forces
from ...diagnosis.conclusions.spectra import spectra
from ...diagnosis.result import Diagnosis
from ...diagnosis.words.titles import title_of
from ..diagnosis_rows import budget_name, candidates
from ..documents.diagnosis import diagnosis_document
from ..page.binning import binned, decided_by
from ..page.time_plots import stretches
from .identification import MEASURED, RESIDUAL, SIMULATED, _labelled, _trace


def figures_of(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Names of the figures that this diagnosis has something to show in."""
    found = (("missing_force",) if missing_forces(diagnosis) else ()) + (("error_budget",) if diagnosis.budget else ())
    return ("extension", "spectrum", "ranking", *found)


def extension(diagnosis: Diagnosis, *, record: int | None = None) -> Figure:
    """What does the extension mend? Measured, linear and extended; the errors of both below.

    **Arguments:** `diagnosis`; `record`: which of `curves`, default the first held-out one.

    **Returns:** the figure: per output the whole record and the stretch where the linear model is worst, errors with
    ±2 noise floors.

    **Raises:** `ValueError` where there is no such record.
    """
    if record is None:
        record = next((k for k, curves in enumerate(diagnosis.curves) if curves.held_out), 0)
    if not 0 <= record < len(diagnosis.curves):
        raise ValueError(f"record={record} is not there; there are {len(diagnosis.curves)} such records.")
    curves, model = diagnosis.curves[record], diagnosis.baseline.model
    outputs = len(model.output_names)
    figure = Figure(figsize=(11.0, 1.0 + 3.2 * outputs), layout="constrained")
    grid = figure.add_gridspec(2 * outputs, 2, height_ratios=[2.0, 1.2] * outputs, width_ratios=[1.5, 1.0])
    kind = "held-out record" if curves.held_out else "record of the fit"
    first = "your model" if diagnosis.own_model else "linear model"
    figure.suptitle(f"Measured, {first} and extended model, {kind}")
    runs = [(first, curves.baseline, RESIDUAL)]
    if diagnosis.extended is not None:
        runs.append(("extended model", curves.extended, SIMULATED))
    for k, (name, unit) in enumerate(zip(model.output_names, model.output_units)):
        floor = 2 * diagnosis.noise_floor[name]
        worst = stretches((curves.measured - curves.baseline)[:, k])[0]
        for column, window in enumerate((slice(0, len(curves.time)), worst)):
            above = figure.add_subplot(grid[2 * k, column])
            below = figure.add_subplot(grid[2 * k + 1, column], sharex=above)
            above.tick_params(labelbottom=False)
            _trace(above, curves, curves.measured[:, k], window, color=MEASURED, linewidth=2.4, label="measured")
            for label, run, colour in runs:
                style = {"color": colour, "linewidth": 0.9, "label": label}
                _trace(above, curves, run[:, k], window, **style)
                style |= {"linewidth": 0.6, "label": None}
                _trace(below, curves, curves.measured[:, k] - run[:, k], window, **style)
            for edge, label in ((-floor, None), (floor, "±2 σ of the noise")):
                below.axhline(edge, color="black", linewidth=0.9, linestyle="--", label=label)
            above.margins(x=0)
            above.set_title(name if column == 0 else "where it is worst", loc="left", fontsize="medium")
            if column == 0:
                above.set_ylabel(_labelled(name, unit))
                below.set_ylabel(_labelled("error", unit))
            if k == 0 and column == 1:
                handles = [part for axes in (above, below) for part in axes.get_legend_handles_labels()[0]]
                above.legend(handles=handles, ncols=2, fontsize="x-small", loc="lower right", bbox_to_anchor=(1.0, 1.0))
            if k == outputs - 1:
                below.set_xlabel("time [s]")
            else:
                below.tick_params(labelbottom=False)
    return figure


def missing_force(diagnosis: Diagnosis, *, finding: int = 0) -> Figure:
    """What does the model lack, and is the law that was found right? Against displacement, velocity, time and input.

    **Arguments:** `diagnosis`; `finding`: which of those that have a law, default the first.

    **Returns:** the figure: samples, their means with ±2 standard errors, and the law on the same motion with its
    band; as points where the variable alone does not decide it.

    **Raises:** `ValueError` where there is no such finding.
    """
    found = missing_forces(diagnosis)
    if not 0 <= finding < len(found):
        raise ValueError(f"finding={finding} is not there; there are {len(found)} that can be drawn.")
    one = found[finding]
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 2, sharey=True)
    names = diagnosis.baseline.model.coordinates
    figure.suptitle(title_of(one.effect, one.location, names) if one.effect else f"What is left at {one.location}")
    for axis, variable in zip(axes.flat, one.variables):
        x = variable.values
        axis.plot(x, one.missing, ".", color="0.72", markersize=2.5, label=f"missing {one.quantity}, measured")
        decides = one.law is None or (variable.name != "time" and decided_by(x, one.law))
        if one.law is not None and not decides:
            axis.plot(x, one.law, ".", color=SIMULATED, markersize=2.5, label="law that was found")
        if one.law is not None and decides:
            at, law, _ = binned(x, one.law)
            axis.plot(at, law, color=SIMULATED, linewidth=1.6, label="law that was found")
            if one.error is not None:
                reach = 2 * binned(x, one.error)[1]
                axis.fill_between(at, law - reach, law + reach, color=SIMULATED, alpha=0.25, linewidth=0)
        if decides:
            at, mean, _ = binned(x, one.missing)
            spread = binned(x, one.missing - (0.0 if one.law is None else one.law))[2]
            axis.errorbar(
                at, mean, 2 * spread, fmt="o", color=RESIDUAL, markersize=3, linewidth=0.9, label="mean ± 2 se"
            )
        axis.set_xlabel(_labelled(variable.name, variable.unit))
        axis.legend(fontsize="x-small")
    low, high = np.quantile(one.missing, [0.005, 0.995])
    axes[0, 0].set_ylim(low - 0.25 * (high - low), high + 0.25 * (high - low))
    for axis in axes[:, 0]:
        axis.set_ylabel(_labelled(f"missing {one.quantity}", one.unit))
    return figure


def spectrum(diagnosis: Diagnosis) -> Figure:
    """Where in frequency is the error, before and after? Spectra of output and errors beside the noise floor.

    **Arguments:** `diagnosis`.

    **Returns:** the figure: a panel per output; of a periodic input, its lines, driven (dots) and not (crosses).
    """
    made, model = spectra(diagnosis), diagnosis.baseline.model
    figure = Figure(figsize=(8.0, 0.8 + 2.8 * model.dofs), layout="constrained")
    axes = figure.subplots(model.dofs, 1, squeeze=False, sharex=True)[:, 0]
    parts = [("measured", MEASURED, made.measured), ("error before", RESIDUAL, made.before)]
    if diagnosis.extended is not None:
        parts.append(("error after", SIMULATED, made.after))
    for k, (axis, name) in enumerate(zip(axes, model.output_names)):
        for label, colour, values in parts:
            if made.driven is None:
                axis.loglog(made.frequency_hz, values[:, k], color=colour, linewidth=1.1, label=label)
                continue
            for chosen, mark in ((made.driven, "."), (~made.driven, "x")):
                if chosen.any() and not (mark == "x" and label == "measured"):
                    style = {"color": colour, "markersize": 4, "label": label if mark == "." else None}
                    axis.loglog(made.frequency_hz[chosen], values[chosen, k], mark, **style)
        axis.axhline(made.floor[k], color="black", linewidth=0.9, linestyle="--", label="noise floor")
        unit = model.output_units[k]
        axis.set_ylabel(_labelled(name, unit and (unit if made.period else f"{unit}/√Hz")))
    axes[0].legend(fontsize="x-small", ncols=4)
    axes[-1].set_xlabel("frequency [Hz]")
    figure.suptitle("Amplitudes of the lines" if made.period else "Amplitude spectral density", fontsize="medium")
    return figure


def ranking(diagnosis: Diagnosis, *, most: int = 15) -> Figure:
    """Which candidates were there, and how strong? ΔBIC at the gate and after the refit.

    **Arguments:** `diagnosis`; `most`: candidates shown, default 15.

    **Returns:** the figure, the strongest on top; those that were taken in bold.
    """
    rows = [row for row in candidates(diagnosis_document(diagnosis)) if max(row["refit"] or 0, row["gate"] or 0) > 1]
    rows = rows[:most][::-1]
    figure = Figure(figsize=(8.0, 1.2 + 0.3 * len(rows)), layout="constrained")
    axis = figure.subplots()
    for key, label, style in (
        ("gate", "at the gate", {"color": RESIDUAL, "markerfacecolor": "none"}),
        ("refit", "after the refit", {"color": SIMULATED}),
    ):
        known = [(row[key], k) for k, row in enumerate(rows) if row[key] is not None and row[key] > 1]
        if known:
            axis.semilogx(*zip(*known), "o", label=label, **style)
    axis.axvline(10, color="0.4", linewidth=0.9, linestyle=":")
    names = diagnosis.baseline.model.coordinates
    axis.set_yticks(range(len(rows)), [title_of(row["effect"], row["location"], names) for row in rows])
    for text, row in zip(axis.get_yticklabels(), rows):
        text.set_fontweight("bold" if row["status"] in ("named", "equivalent", "partly") else "normal")
    axis.set_xlabel("ΔBIC (counts from 10)")
    axis.grid(axis="y", color="0.92")
    if rows:
        axis.legend(fontsize="small")
    return figure


def error_budget(diagnosis: Diagnosis) -> Figure:
    """Where does the error of the model before come from? Shares of its mean square.

    **Arguments:** `diagnosis`.

    **Returns:** the figure: a bar per term, noise, and the unexplained.

    **Raises:** `ValueError` where there is no budget.
    """
    if not diagnosis.budget:
        raise ValueError("This diagnosis has no error budget: nothing was found that takes a share of the error.")
    names = diagnosis.baseline.model.coordinates
    figure = Figure(figsize=(7.5, 1.0 + 0.42 * len(diagnosis.budget)), layout="constrained")
    axis = figure.subplots()
    labels = [budget_name(key, names) for key in diagnosis.budget]
    colours = [{"noise": MEASURED, "unexplained": RESIDUAL}.get(key, SIMULATED) for key in diagnosis.budget]
    bars = axis.barh(labels, list(diagnosis.budget.values()), color=colours)
    axis.bar_label(bars, fmt="%.1f %%", padding=3)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.set_xlabel("share of the mean square error [%]")
    return figure
