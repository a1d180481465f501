"""The commands around the diagnosis: what is wrong with a model, which effects are known, a demonstration."""

import functools

from .arguments import (
    Channels,
    Demonstrating,
    Diagnosing,
    Excitation,
    File,
    Fitting,
    Listing,
    Output,
    OwnSimulator,
    Reporting,
    Talk,
    hidden_of,
    takes_groups,
    words,
)
from .finishing import drawn, finish, page, subspace_options

HOLDOUT = 0.3
"""Share of the record that is held out where nothing else is said."""


@takes_groups
def diagnose(
    file: File,
    channels: Channels,
    excitation: Excitation,
    fitting: Fitting,
    diagnosing: Diagnosing,
    simulating: OwnSimulator,
    output: Output,
    reporting: Reporting,
    talk: Talk,
) -> None:
    """Say what a model of the record gets wrong, name the cause, add it, and prove the gain on held-out data.

    The model is fitted to the record, or given by --model, or is your own simulator, given by --simulator, or what
    moves as your simulation does, whose outputs --simulated names among the columns. Without --validation and --holdout
    the last 30 % of the record are held out.
    """
    from ..report import terminal
    from . import files

    files.check_holdout(channels)
    places = output.json, reporting.report, diagnosing.experiment, simulating.mended
    read = file.file, channels.validation, diagnosing.model, simulating.simulator
    files.check_places(*places, read=read, folder=output.figures)
    checked(fitting, diagnosing)
    check_simulator(simulating, diagnosing, excitation, fitting)
    options = subspace_options(excitation)
    notes: list[str] = []
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("reading")
        record = files.read(file.file, file, channels, notes)
        validation = None if channels.validation is None else files.read(channels.validation, file, channels, notes)
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose, quiet=talk.quiet)
        only, exclude = ids("--only", diagnosing.only), ids("--exclude", diagnosing.exclude)
        model = None
        if diagnosing.model is not None:
            model = files.own_model(diagnosing.model, record, excitation)
        from ..diagnosis.diagnose import diagnose
        from ..report.diagnosis_terminal import show_diagnosis
        from ..report.documents.diagnosis import diagnosis_document

        if simulating.simulator is None:
            options |= {"structure": words(fitting.structure), "fix": fitting.fix, "noise": fitting.noise}
            if fitting.hidden is not None:
                options["hidden"] = hidden_of(fitting.hidden)
        elif files.is_mujoco(simulating.simulator) or files.is_fmu(simulating.simulator):
            own = files.other_program(simulating.simulator, record, simulating.parameters, simulating.forces)
            options = {"simulator": own, "parameters": own.numbers, "workers": simulating.workers}
        else:
            numbers = files.parameters(simulating.parameters)
            options = {"simulator": files.simulator(simulating.simulator), "parameters": numbers}
            options |= {"workers": simulating.workers}
        result = diagnose(
            record,
            validation=validation,
            model=model,
            only=only,
            exclude=exclude,
            max_effects=diagnosing.max_effects,
            budget=diagnosing.budget,
            seed=diagnosing.seed,
            progress=progress,
            simulated=files.simulated(simulating.simulated, file, channels, []),
            holdout=HOLDOUT if channels.holdout is None else channels.holdout,
            **options,
        )
        progress.stage("reporting")
        if diagnosing.experiment is not None and result.next_experiment is None:
            notes.append(f"{diagnosing.experiment} is not written: there is no experiment to propose.")
        if simulating.mended is not None:
            notes += [
                f"{simulating.mended} lacks {what}: MJCF has no attribute for it." for what in own.unwritten(result)
            ]
        document = diagnosis_document(result, tuple(notes))
        written = _pictures(output, result)
        if simulating.mended is not None:
            written[simulating.mended] = own.mended(result).encode()
        written |= page(reporting.report, result, notes)
        if diagnosing.experiment is not None and result.next_experiment is not None:
            proposed = result.next_experiment
            from ..report.documents.columns import columns_text, input_columns

            table = input_columns(record, proposed.input, proposed.sampling_time)
            written[diagnosing.experiment] = columns_text(table).encode()
    show = functools.partial(show_diagnosis, verbose=talk.verbose)
    finish(document, show, talk, output.json, written, notes)


def _pictures(output: Output, result) -> dict:
    """The figures of a diagnosis and of its linear fit, by the files they go to."""
    if output.figures is None:
        return {}
    from ..report.figures.diagnosis import figures_of

    made = drawn(output.figures, "diagnosis", figures_of(result), result)
    if result.identification is not None:
        made |= drawn(output.figures, "identification", ("compare", "residuals", "bode"), result.identification)
        made |= drawn(output.figures, "modal", ("mode_shapes",), result.identification)
    return made


def checked(fitting: Fitting, diagnosing: Diagnosing) -> None:
    """Raise `ValueError` for options that do not go together, or numbers that are none."""
    if fitting.no_refine:
        raise ValueError("--no-refine: a diagnosis needs the refined model; leave the option out.")
    fitted = fitting.structure, fitting.fix, fitting.hidden
    if diagnosing.model is not None and fitted != (None, None, None):
        raise ValueError(
            "--structure, --fix and --hidden are about a model that is fitted; leave them out with --model."
        )
    if diagnosing.max_effects < 0:
        raise ValueError(f"--max-effects={diagnosing.max_effects} is negative; give a whole number from 0.")
    if diagnosing.budget is not None and not diagnosing.budget > 0:
        raise ValueError(f"--budget={diagnosing.budget:g} is no time; give a positive number of seconds.")
    if diagnosing.seed < 0:
        raise ValueError(f"--seed={diagnosing.seed} is negative; give a whole number from 0.")


def check_simulator(simulating: OwnSimulator, diagnosing: Diagnosing, excitation: Excitation, fitting: Fitting) -> None:
    """Raise `ValueError` for options of a simulator that do not go together."""
    from . import files

    if simulating.simulator is not None and diagnosing.model is not None:
        raise ValueError("--simulator and --model are two things to judge; give one of them.")
    if simulating.simulated is not None and (simulating.simulator, diagnosing.model) != (None, None):
        raise ValueError("--simulated is judged in the place of --simulator or --model; give one of them.")
    if simulating.simulator is not None:
        for group, usual in ((excitation, Excitation()), (fitting, Fitting())):
            for name, value in vars(group).items():
                if value != getattr(usual, name):
                    option = "--" + name.replace("_", "-")
                    raise ValueError(f"{option} is about a model that is fitted; leave it out with --simulator.")
    if simulating.mended is not None and not files.is_mujoco(simulating.simulator):
        raise ValueError("--mended writes a model of MuJoCo; give --simulator MODEL.xml as well.")
    if (simulating.forces is not None) != files.is_fmu(simulating.simulator):
        raise ValueError(
            f"--forces={simulating.forces} with --simulator={simulating.simulator}: an FMU needs the names of its "
            "inputs that are forces at the outputs, and no other simulator takes --forces."
        )
    if simulating.simulator is None and simulating.parameters is not None:
        raise ValueError("--parameters are those of a simulator; give --simulator FILE.py:FUNCTION as well.")
    if simulating.workers < 1:
        raise ValueError(f"--workers={simulating.workers} is no number of processes; give a whole number from 1.")


def ids(option: str, text: str | None) -> tuple[str, ...] | None:
    """Ids of effects with commas, None for none; a `ValueError` names the option and what may have been meant."""
    if text is None:
        return None
    from ..mechanics.effects import by_id

    found = words(text)
    if not found:
        raise ValueError(f"{option} is empty; name one or several effects, with commas between.")
    try:
        return tuple(by_id(one).id for one in found)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from None


@takes_groups
def effects(listing: Listing) -> None:
    """List every effect that a diagnosis can name: law, parameters with units, places, what gives it away."""
    from . import files
    from .environment import prepare

    files.check_places(listing.json)
    prepare()
    from ..report.documents.catalogue import catalogue_document, show_catalogue

    document = catalogue_document()
    finish(document, show_catalogue, Talk(), listing.json, {}, [])


@takes_groups
def demo(demonstrating: Demonstrating, talk: Talk) -> None:
    """Simulate a system of known mass, damping and stiffness with a hidden effect, diagnose it, and compare."""
    from ..report import terminal
    from . import files

    files.check_places(folder=demonstrating.out)
    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("starting")
        from .environment import prepare

        prepare(verbose=talk.verbose, quiet=talk.quiet)
        from .. import demonstration
        from ..numerics.whole_files import write_together
        from ..report.documents import export
        from ..report.documents.columns import columns_text, record_columns
        from ..report.documents.diagnosis import diagnosis_document

        made = demonstration.demonstrate(demonstrating.effect, demonstrating.seed, progress=progress)
        document = diagnosis_document(made.diagnosis)
        written = {}
        if demonstrating.out is not None:
            folder = demonstrating.out
            folder.mkdir(parents=True, exist_ok=True)
            for name, record in (("estimation", made.estimation), ("validation", made.validation)):
                text = columns_text(record_columns(record))
                written[folder / f"{name}.csv"] = text.encode()
            written |= page(folder / "report.html", made.diagnosis, [])
            for name, one in (("truth", demonstration.truth_document(made)), ("result", document)):
                written[folder / f"{name}.json"] = export.json_text(one).encode()
    write_together(written)
    if not talk.quiet:
        demonstration.show(terminal.console(), made, document)
