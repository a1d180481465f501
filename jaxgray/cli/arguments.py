"""The options, in groups that commands share: each is declared once, a command takes whole groups."""

import dataclasses
import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_type_hints

import typer


def takes_groups(command):
    """Let a command have dataclasses of options as parameters; on the command line their fields stand alone.

    **Arguments:** `command`: a function whose annotated parameters are such dataclasses.

    **Returns:** a function with the fields of all of them as keywords, those without a default first.
    """
    groups = {name: kind for name, kind in get_type_hints(command).items() if name != "return"}
    parameters = []
    for kind in groups.values():
        hints = get_type_hints(kind, include_extras=True)
        for field in dataclasses.fields(kind):
            default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
            parameters.append(
                inspect.Parameter(
                    field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[field.name]
                )
            )
    parameters.sort(key=lambda parameter: parameter.default is not inspect.Parameter.empty)

    def flat(**values):
        made = {
            name: kind(**{field.name: values[field.name] for field in dataclasses.fields(kind)})
            for name, kind in groups.items()
        }
        command(**made)

    flat.__name__, flat.__doc__ = command.__name__, command.__doc__
    flat.__signature__ = inspect.Signature(parameters)
    flat.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return flat


def _option(*names: str, help: str, metavar: str | None = None):
    return typer.Option(*names, help=help, metavar=metavar, show_default=True)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How files are read."""

    time: Annotated[str | None, _option("--time", metavar="COLUMN", help="Time column (default: t or time).")] = None
    sampling_time: Annotated[
        float | None, _option("--sampling-time", metavar="SECONDS", help="Instead of a time column.")
    ] = None
    scheduling: Annotated[
        str | None, _option("--scheduling", metavar="COLUMN", help="A column the system may depend on.")
    ] = None
    delimiter: Annotated[
        str | None, _option("--delimiter", metavar="CHARACTER", help="Between cells of text; tab, space for blanks.")
    ] = None
    decimal: Annotated[
        str | None, _option("--decimal", metavar=".|,", help="Decimal point or comma of text (default: found).")
    ] = None
    input_units: Annotated[
        str | None, _option("--input-units", metavar="N,…", help="Units instead of those in the headers.")
    ] = None
    output_units: Annotated[str | None, _option("--output-units", metavar="M,…", help="The same for the outputs.")] = (
        None
    )
    own_times: Annotated[
        bool | None,
        typer.Option(
            "--own-times/--uniform",
            help="Whether rows keep the times of their column; empty cells are then no samples (default: if needed).",
            show_default=False,
        ),
    ] = None
    also: Annotated[
        list[str] | None,
        _option("--also", metavar="FILE:COLUMN,…", help="Columns of another file with times of its own; repeatable."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class File(Reading):
    """What is read, and how."""

    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The record: csv, tsv, txt, npz, npy, mat, parquet, hdf5, uff.")
    ]


@dataclass(frozen=True, kw_only=True)
class Channels:
    """Which columns are what."""

    inputs: Annotated[str, _option("--inputs", metavar="A,B", help="Columns of the inputs.")]
    outputs: Annotated[str, _option("--outputs", metavar="C,D", help="Columns of the outputs.")]
    hold: Annotated[str, _option("--hold", metavar="zero|linear|band-limited", help="The input between samples.")] = (
        "zero"
    )
    measured: Annotated[
        str,
        _option(
            "--measured",
            metavar="displacement|velocity|acceleration",
            help="What the outputs are: one for all, or one per output, with commas.",
        ),
    ] = "displacement"
    validation: Annotated[
        Path | None, _option("--validation", metavar="FILE", help="A record that the fit does not see.")
    ] = None
    holdout: Annotated[
        float | None, _option("--holdout", metavar="SHARE", help="Hold out the last part, such as 0.3.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """How the system is driven, and the manner of the subspace start."""

    excitation: Annotated[
        str,
        _option(
            "--excitation",
            metavar="force|base|base-displacement|base-acceleration",
            help="What the inputs are; base: kind by the unit.",
        ),
    ] = "force"
    relative: Annotated[bool, _option("--relative", help="Outputs are measured relative to a moving base.")] = False
    input_map: Annotated[
        str | None,
        _option("--input-map", metavar="U1:Y1,U2:Y1-Y2", help="Where inputs act (default: input j on output j)."),
    ] = None
    time_constant: Annotated[
        str | None,
        _option("--time-constant", metavar="SECONDS,…", help="Time constants of the filter to try."),
    ] = None
    block_rows: Annotated[str | None, _option("--block-rows", metavar="I,…", help="Numbers of block rows to try.")] = (
        None
    )
    weight: Annotated[
        str,
        _option("--weight", metavar="moesp|n4sid|cva|past-inputs", help="Weight of the projection."),
    ] = "moesp"
    map: Annotated[str, _option("--map", metavar="exact|paper", help="The way from the filter back to time.")] = "exact"


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """What is free in the model, and how it is refined."""

    structure: Annotated[
        str | None,
        _option(
            "--structure",
            metavar="diagonal-mass,chain,modal-damping|Y1-H1,H1-GROUND",
            help="Any of these, with commas; or connections of named coordinates (:spring, :damper for one alone).",
        ),
    ] = None
    fix: Annotated[
        str | None,
        _option(
            "--fix", metavar="TEXT", help="Known entries: 'stiffness[0,1]=0,mass[0,0]=5', or 'stiffness[y1-h1]=9'."
        ),
    ] = None
    noise: Annotated[
        str,
        _option(
            "--noise",
            metavar="output-error|innovations",
            help="Where noise enters: at the outputs, or at the forces too.",
        ),
    ] = "output-error"
    hidden: Annotated[
        str | None,
        _option(
            "--hidden",
            metavar="N|auto|NAMES",
            help="Coordinates that no output measures: how many, their names, or auto.",
        ),
    ] = None
    no_refine: Annotated[bool, _option("--no-refine", help="Stop at the starting model.")] = False


@dataclass(frozen=True, kw_only=True)
class Talk:
    """How much is said."""

    quiet: Annotated[bool, _option("--quiet", help="Print nothing but errors.")] = False
    verbose: Annotated[bool, _option("--verbose", help="Print every stage, and the trace of an error.")] = False


@dataclass(frozen=True, kw_only=True)
class Output:
    """Where results go."""

    json: Annotated[
        str | None, _option("--json", metavar="OUT", help="Write the result as JSON; - for the screen.")
    ] = None
    figures: Annotated[Path | None, _option("--figures", metavar="DIR", help="Draw the figures, as PNG.")] = None


@dataclass(frozen=True, kw_only=True)
class Reporting:
    """Where the page goes."""

    report: Annotated[
        Path | None, _option("--report", metavar="OUT.html", help="Write the result as one page for a browser.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class Spacing:
    """Which time constants a sweep takes by itself."""

    spacing: Annotated[
        str,
        _option("--spacing", metavar="logarithmic|linear", help="Spacing of the time constants, where none are given."),
    ] = "logarithmic"


@dataclass(frozen=True, kw_only=True)
class Simulating:
    """What `simulate` takes besides the file."""

    model: Annotated[Path, typer.Argument(metavar="MODEL.json", help="A model, or a result of identify or diagnose.")]
    inputs: Annotated[
        str | None, _option("--inputs", metavar="A,B", help="Columns of the inputs (default: the model's).")
    ] = None
    outputs: Annotated[
        str | None, _option("--outputs", metavar="C,D", help="Columns of the outputs (default: the model's).")
    ] = None
    hold: Annotated[
        str | None,
        _option("--hold", metavar="zero|linear", help="The input between samples (default: the model's)."),
    ] = None
    out: Annotated[
        Path | None, _option("--out", metavar="CSV", help="Write time, measured, simulated and residual.")
    ] = None
    json: Annotated[str | None, _option("--json", metavar="OUT", help="Write fits as JSON; - for the screen.")] = None


@dataclass(frozen=True, kw_only=True)
class Exporting:
    """What `export` takes."""

    model: Annotated[Path, typer.Argument(metavar="MODEL.json", help="A model, or a result of identify or diagnose.")]
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="Ending in .mat (MATLAB), .xml (MuJoCo), .h (C), .json or .npz.")
    ]
    sampling_time: Annotated[
        float | None,
        _option("--sampling-time", metavar="SECONDS", help="That of the sampled system (default: of the record)."),
    ] = None
    hold: Annotated[
        str | None, _option("--hold", metavar="zero|linear", help="The input between samples (default: the record's).")
    ] = None
    linear: Annotated[bool, _option("--linear", help="Leave out effects that are not linear.")] = False


@dataclass(frozen=True, kw_only=True)
class Diagnosing:
    """What `diagnose` takes besides the options of `identify`."""

    model: Annotated[
        Path | None,
        _option("--model", metavar="MODEL.json", help="Judge this model instead of one fitted to the record."),
    ] = None
    only: Annotated[
        str | None, _option("--only", metavar="ID,…", help="Look for these effects only (jaxgray effects lists them).")
    ] = None
    exclude: Annotated[str | None, _option("--exclude", metavar="ID,…", help="Do not look for these effects.")] = None
    max_effects: Annotated[int, _option("--max-effects", metavar="N", help="Add at most so many effects.")] = 4
    budget: Annotated[
        float | None,
        _option("--budget", metavar="SECONDS", help="End the search after this time, with the best found until then."),
    ] = None
    seed: Annotated[int, _option("--seed", metavar="N", help="Seed of the draws behind thresholds and intervals.")] = 0
    experiment: Annotated[
        Path | None,
        _option("--experiment", metavar="OUT.csv", help="Write the input of the experiment that is proposed, if any."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class OwnSimulator:
    """A simulator of the user's own, which `diagnose` judges."""

    simulator: Annotated[
        str | None,
        _option(
            "--simulator",
            metavar="FILE.py:FUNCTION|MODEL.xml|UNIT.fmu",
            help="Judge this simulator y = f(u, w, numbers) instead, this model of MuJoCo or this FMU.",
        ),
    ] = None
    parameters: Annotated[
        str | None,
        _option("--parameters", metavar="NAME=X,…", help="The simulator's numbers; of MJCF or an FMU, their names."),
    ] = None
    forces: Annotated[
        str | None,
        _option("--forces", metavar="NAME,…", help="Inputs of the UNIT.fmu that are forces at the outputs."),
    ] = None
    mended: Annotated[
        Path | None, _option("--mended", metavar="OUT.xml", help="Write the MODEL.xml with what was found.")
    ] = None
    workers: Annotated[int, _option("--workers", metavar="N", help="Processes that run the simulator.")] = 1
    simulated: Annotated[
        str | None,
        _option("--simulated", metavar="COLUMN,…", help="Judge the simulation whose outputs these columns are."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """What `fleet` takes besides the options of one record."""

    files: Annotated[list[str], typer.Argument(metavar="FILES…", help="Records, or patterns such as 'data/*.parquet'.")]
    out: Annotated[
        Path, _option("--out", metavar="DIR", help="Folder of the results; a second call does what is left.")
    ]
    task: Annotated[str, _option("--task", metavar="identify|diagnose", help="What is done with each.")] = "identify"
    workers: Annotated[
        int | None, _option("--workers", metavar="N", help="Processes of this machine (default: one a core).")
    ] = None
    scheduler: Annotated[
        str | None,
        _option("--scheduler", metavar="ADDRESS", help="Where a Dask scheduler runs, instead of here."),
    ] = None
    machine: Annotated[
        str | None,
        _option("--machine", metavar="PATTERN", help="Pattern of the file names, such as '{machine}_{when}.parquet'."),
    ] = None
    when_column: Annotated[
        str | None, _option("--when-column", metavar="COLUMN", help="Column that says when, instead of the file name.")
    ] = None
    covariates: Annotated[
        str | None, _option("--covariates", metavar="A,B", help="Columns such as a temperature, kept by their means.")
    ] = None
    no_pages: Annotated[bool, _option("--no-pages", help="Write no page for each record.")] = False
    again: Annotated[bool, _option("--again", help="Compute anew what has failed before.")] = False
    json: Annotated[
        str | None, _option("--json", metavar="OUT", help="Write the summary as JSON; - for the screen.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class Listing:
    """What `effects` takes."""

    json: Annotated[str | None, _option("--json", metavar="OUT", help="Write the list as JSON; - for the screen.")] = (
        None
    )


@dataclass(frozen=True, kw_only=True)
class Demonstrating:
    """What `demo` takes."""

    effect: Annotated[
        str, _option("--effect", metavar="ID", help="What the simulated system hides; none for nothing.")
    ] = "coulomb_friction"
    out: Annotated[
        Path | None, _option("--out", metavar="DIR", help="Write the records, the truth, the result and its page.")
    ] = None
    seed: Annotated[int, _option("--seed", metavar="N", help="Seed of the inputs and the noise.")] = 1


@dataclass(frozen=True, kw_only=True)
class Manual:
    """What `docs` takes."""

    out: Annotated[
        Path | None, _option("--out", metavar="DIR", help="Write the manual to this folder, and open nothing.")
    ] = None


def words(text: str | None) -> list[str]:
    """The parts of a list with commas; commas in brackets belong to a name, as in `u[0,1]`."""
    parts, depth, last = [], 0, 0
    for k, letter in enumerate(text or ""):
        depth += (letter in "[(") - (letter in "])")
        if letter == "," and depth <= 0:
            parts.append(text[last:k])
            last = k + 1
    parts.append((text or "")[last:])
    return [part.strip() for part in parts if part.strip()]


def numbers(option: str, text: str | None, kind=float) -> list | None:
    """Numbers with commas, None for none; a `ValueError` names the option."""
    if text is None:
        return None
    try:
        return [kind(word) for word in words(text)] or None
    except ValueError:
        what = "whole numbers" if kind is int else "numbers"
        raise ValueError(f"{option}={text!r} is not understood; give {what} with commas between.") from None


def hidden_of(text: str | None):
    """What `--hidden` says: a number, "auto", or names."""
    if text is None:
        return 0
    text = text.strip()
    if text == "auto":
        return text
    if text.isdecimal():
        return int(text)
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names or any(_is_number(name) for name in names):
        raise ValueError(
            f"--hidden={text!r} is not understood; give a whole number, auto, or names with commas between."
        )
    return names


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
