"""The commands, one function each; jax is loaded only once a command runs."""

import dataclasses

import typer

from . import diagnosing, docs, fleet, schema
from .arguments import (
    Channels,
    Excitation,
    Exporting,
    File,
    Fitting,
    Output,
    Reporting,
    Simulating,
    Spacing,
    Talk,
    hidden_of,
    takes_groups,
    words,
)
from .finishing import drawn, finish, page, subspace_options

app = typer.Typer(
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    no_args_is_help=False,
    help="Mass, damping and stiffness of a mechanical system from measured force and motion, and what a model of it "
    "gets wrong.",
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


@app.command(short_help="Find mass, damping and stiffness, with error bars.")
@takes_groups
def identify(
    file: File,
    channels: Channels,
    excitation: Excitation,
    fitting: Fitting,
    output: Output,
    reporting: Reporting,
    talk: Talk,
) -> None:
    """Find mass, damping and stiffness, with error bars, and say how well they explain the record."""
    from ..report import terminal
    from . import files

    files.check_holdout(channels)
    files.check_places(output.json, reporting.report, read=(file.file, channels.validation), folder=output.figures)
    options = subspace_options(excitation)
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("reading")
        record, validation = files.read_pair(file, channels, notes)
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose, quiet=talk.quiet)
        from ..identification import identify
        from ..report.documents import identification as summary

        result = identify(
            record,
            validation=validation,
            refine=not fitting.no_refine,
            structure=words(fitting.structure),
            fix=fitting.fix,
            noise=fitting.noise,
            hidden=hidden_of(fitting.hidden),
            progress=progress,
            **options,
        )
        progress.stage("reporting")
        document = summary.identification_document(result, tuple(notes))
        pictures = drawn(output.figures, "identification", ("compare", "residuals", "bode"), result)
        pictures |= drawn(output.figures, "modal", ("mode_shapes",), result)
        pictures |= page(reporting.report, result, notes)
    finish(document, terminal.show_identification, talk, output.json, pictures, notes)


app.command(short_help="Say what a model gets wrong, and why.")(diagnosing.diagnose)
app.command(short_help="Do either for many records, on many workers.")(fleet.fleet)


@app.command(short_help="Tabulate time constants and block rows of the start.")
@takes_groups
def sweep(file: File, channels: Channels, excitation: Excitation, spacing: Spacing, output: Output, talk: Talk) -> None:
    """Try time constants and block rows of the subspace start, and tabulate what each explains."""
    from ..report import terminal
    from . import files

    files.check_holdout(channels)
    files.check_places(output.json, read=(file.file, channels.validation), folder=output.figures)
    options = subspace_options(excitation)
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("reading")
        record, validation = files.read_pair(file, channels, notes)
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose, quiet=talk.quiet)
        from ..identification import sweep
        from ..report.documents import identification as summary

        result = sweep(record, validation=validation, spacing=spacing.spacing, progress=progress, **options)
        document = summary.sweep_document(result, tuple(notes))
        pictures = drawn(output.figures, "identification", ("sweep_map",), result)
    finish(document, terminal.show_sweep, talk, output.json, pictures, notes)


@app.command(short_help="Run a model freely against a record.")
@takes_groups
def simulate(simulating: Simulating, file: File, talk: Talk) -> None:
    """Run a model, its effects included, freely against a record, its first state and offsets fitted."""
    from ..report import terminal
    from . import files

    files.check_places(simulating.json, simulating.out, read=(file.file, simulating.model))
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose, quiet=talk.quiet)
        from ..identification.validation.residuals import fit_of
        from ..mechanics.at_stamps import at_own_times
        from ..mechanics.fitted_run import fitted_run
        from ..report.documents import export
        from ..report.documents import identification as summary
        from ..report.documents.columns import columns_text, simulation_columns

        model = export.load(simulating.model)
        progress.stage("reading")
        wanted = dataclasses.replace(
            simulating,
            inputs=simulating.inputs or model.input_names,
            outputs=simulating.outputs or model.output_names,
            hold=simulating.hold or files.record_of(simulating.model).get("hold", "zero"),
        )
        record = files.read(file.file, file, _Wanted(wanted, model.measured), notes)
        if (record.inputs, record.outputs) != (model.inputs, model.outputs):
            raise ValueError(
                f"the model has {model.inputs} inputs and {model.outputs} outputs, --inputs and --outputs name "
                f"{record.inputs} and {record.outputs}; name as many."
            )
        progress.stage("simulating")
        record = at_own_times(model, record)
        run = fitted_run(model, record).simulated
        fit = fit_of(record.y, run)
        document = summary.simulation_document(record, fit, tuple(notes))
        written = {}
        if simulating.out is not None:
            written[simulating.out] = columns_text(simulation_columns(record, run)).encode()
    finish(document, terminal.show_simulation, talk, simulating.json, written, notes)


class _Wanted:
    """The channels of a model, in the words of the options."""

    def __init__(self, simulating: Simulating, measured: tuple[str, ...]):
        self.inputs, self.outputs = simulating.inputs, simulating.outputs
        self.hold, self.measured = simulating.hold, measured


@app.command(short_help="Write a model for MATLAB, MuJoCo or C.")
@takes_groups
def export(exporting: Exporting, talk: Talk) -> None:
    """Write a model for another program, by the ending of the file; effects that it does not know are refused."""
    from . import files
    from .environment import prepare

    files.check_places(exporting.out, read=(exporting.model,))
    prepare(verbose=talk.verbose, quiet=talk.quiet)
    from ..report import exports
    from ..report.documents.export import load

    model, record = load(exporting.model), files.record_of(exporting.model)
    exports.export(
        model,
        exporting.out,
        sampling_time=record.get("sampling_time") if exporting.sampling_time is None else exporting.sampling_time,
        hold=exporting.hold or record.get("hold", "zero"),
        linear=exporting.linear,
    )
    if not talk.quiet:
        counts = {"coordinate": model.dofs, "input": model.inputs, "effect": len(model.effects)}
        if exporting.linear:
            counts["effect"] = 0
        parts = [f"{count} {word}{'s' if count != 1 else ''}" for word, count in counts.items() if count]
        print(f"{exporting.out}: {', '.join(parts)}")


app.command(short_help="List the effects that a diagnosis can name.")(diagnosing.effects)
app.command(short_help="Diagnose a simulated system of known truth.")(diagnosing.demo)
app.command(short_help="Open the manual, or write it to a folder.")(docs.docs)
app.command(short_help="Print the JSON Schema of what is written.")(schema.schema)
