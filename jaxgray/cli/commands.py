"""The commands, one function each; jax is loaded only once a command runs."""

import dataclasses
import json
import sys
from pathlib import Path

import typer

from .arguments import (
    Channels,
    Demonstrating,
    Excitation,
    File,
    Fitting,
    Output,
    Simulating,
    Spacing,
    Talk,
    numbers,
    takes_groups,
    words,
)

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    no_args_is_help=False,
    help="Mass, damping and stiffness of a mechanical system from measured force and motion.",
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(version("jaxgray"))
        raise typer.Exit()


@app.callback()
def _top(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print it."),
) -> None:
    pass


def _finish(
    document: dict, show, talk: Talk, target: str | None, files: dict[Path, bytes], notes: list[str]
) -> None:
    """Write everything that was asked for, then say it; the reader's notes go to the error stream."""
    from ..report import export, terminal

    for path, content in files.items():
        export._write_whole(content, path)
    if target is not None and target != "-":
        export.write_json(document, target)
    if target == "-":
        sys.stdout.write(json.dumps(export._plain(document, ""), allow_nan=False, indent=1) + "\n")
        notes = document["warnings"]
    elif not talk.quiet:
        own = [text for text in document["warnings"] if text not in notes]
        show(terminal.console(), document | {"warnings": own})
    if not talk.quiet:
        for text in notes:
            print(f"warning: {' '.join(text.split())}", file=sys.stderr)


def _drawn(folder: Path | None, result, names: tuple[str, ...]) -> dict[Path, bytes]:
    """Figures as PNG, by the files they go to."""
    if folder is None:
        return {}
    import io

    from ..report import figures

    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name in names:
        buffer = io.BytesIO()
        getattr(figures, name)(result).savefig(buffer, format="png", dpi=150)
        files[folder / f"{name}.png"] = buffer.getvalue()
    return files


def _subspace_options(excitation: Excitation) -> dict:
    return {
        "excitation": excitation.excitation,
        "relative": excitation.relative,
        "input_map": excitation.input_map,
        "time_constants": numbers("--time-constant", excitation.time_constant),
        "block_rows": numbers("--block-rows", excitation.block_rows, int),
        "weight": excitation.weight,
        "map": excitation.map,
    }


@app.command(short_help="Find mass, damping and stiffness, with error bars.")
@takes_groups
def identify(
    file: File, channels: Channels, excitation: Excitation, fitting: Fitting, output: Output, talk: Talk
) -> None:
    """Find mass, damping and stiffness, with error bars, and say how well they explain the record."""
    from ..report import terminal
    from . import files

    files.check_holdout(channels)
    files.check_places(output.json)
    options = _subspace_options(excitation)
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("reading")
        record, validation = files.read_pair(file, channels, notes)
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose)
        from ..identification import identify
        from ..report import summary

        result = identify(
            record,
            validation=validation,
            refine=not fitting.no_refine,
            structure=words(fitting.structure),
            fix=fitting.fix,
            noise=fitting.noise,
            progress=progress,
            **options,
        )
        progress.stage("reporting")
        document = summary.identification_document(result, tuple(notes))
        drawn = _drawn(output.figures, result, ("compare", "residuals", "bode"))
    _finish(document, terminal.show_identification, talk, output.json, drawn, notes)


@app.command(short_help="Tabulate time constants and block rows of the start.")
@takes_groups
def sweep(
    file: File, channels: Channels, excitation: Excitation, spacing: Spacing, output: Output, talk: Talk
) -> None:
    """Try time constants and block rows of the subspace start, and tabulate what each explains."""
    from ..report import terminal
    from . import files

    files.check_holdout(channels)
    files.check_places(output.json)
    options = _subspace_options(excitation)
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("reading")
        record, validation = files.read_pair(file, channels, notes)
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose)
        from ..identification import sweep
        from ..report import summary

        result = sweep(record, validation=validation, spacing=spacing.spacing, progress=progress, **options)
        document = summary.sweep_document(result, tuple(notes))
        drawn = _drawn(output.figures, result, ("sweep_map",))
    _finish(document, terminal.show_sweep, talk, output.json, drawn, notes)


@app.command(short_help="Run a model freely against a record.")
@takes_groups
def simulate(simulating: Simulating, file: File, talk: Talk) -> None:
    """Run a model freely against a record, its first state and offsets fitted."""
    from ..report import terminal
    from . import files

    files.check_places(simulating.json, simulating.out)
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose)
        from ..identification.validation import fit_of
        from ..mechanics.simulate import initial_state
        from ..report import export, summary

        model = export.load(simulating.model)
        progress.stage("reading")
        wanted = dataclasses.replace(
            simulating,
            inputs=simulating.inputs or model.input_names,
            outputs=simulating.outputs or model.output_names,
            hold=simulating.hold or _hold_of(simulating.model),
        )
        record = files.read(file.file, file, _Wanted(wanted, model.measured), notes)
        if (record.inputs, record.outputs) != (model.inputs, model.dofs):
            raise ValueError(
                f"the model has {model.inputs} inputs and {model.dofs} outputs, --inputs and --outputs name "
                f"{record.inputs} and {record.outputs}; name as many."
            )
        progress.stage("simulating")
        state, offset = initial_state(model, record.u, record.y, record.sampling_time, hold=record.hold)
        run = model.simulate(record, x0=state, offset=offset)
        fit = fit_of(record.y, run)
        document = summary.simulation_document(record, fit, tuple(notes))
        written = {}
        if simulating.out is not None:
            columns = files.simulation_columns(record, run)
            written[simulating.out] = files.columns_text(columns).encode()
    _finish(document, terminal.show_simulation, talk, simulating.json, written, notes)


class _Wanted:
    """The channels of a model, in the words of the options."""

    def __init__(self, simulating: Simulating, measured: tuple[str, ...]):
        self.inputs, self.outputs = simulating.inputs, simulating.outputs
        self.hold, self.measured = simulating.hold, measured


def _hold_of(path: Path) -> str:
    """The hold of the record that the model came from, where its file says so."""
    if path.suffix.lower() != ".json":
        return "zero"
    records = json.loads(path.read_text(encoding="utf-8")).get("records")
    estimation = records.get("estimation") if isinstance(records, dict) else None
    return estimation[0].get("hold", "zero") if estimation else "zero"


@app.command(short_help="Identify a simulated system of known truth.")
@takes_groups
def demo(demonstrating: Demonstrating, talk: Talk) -> None:
    """Identify a simulated system of known mass, damping and stiffness, and compare."""
    from ..report import terminal

    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose)
        from .. import demonstration
        from ..report import export, summary
        from . import files

        made = demonstration.demonstrate(demonstrating.seed, progress=progress)
        document = summary.identification_document(made.result)
        written = {}
        if demonstrating.out is not None:
            folder = demonstrating.out
            folder.mkdir(parents=True, exist_ok=True)
            for name, record in (("estimation", made.estimation), ("validation", made.validation)):
                text = files.columns_text(files.record_columns(record))
                written[folder / f"{name}.csv"] = text.encode()
    for path, content in written.items():
        export._write_whole(content, path)
    if demonstrating.out is not None:
        export.write_json(demonstration.truth_document(made), demonstrating.out / "truth.json")
        export.write_json(document, demonstrating.out / "result.json")
    if not talk.quiet:
        demonstration.show(terminal.console(), made, document)
