"""The command for many records: identify or diagnose each on as many workers as there are."""

from .arguments import Channels, Diagnosing, Excitation, Fitting, Fleet, Reading, Talk, hidden_of, takes_groups, words
from .files import DELIMITERS
from .finishing import finish, subspace_options


class Interrupted(Exception):
    """Ctrl-C, with what is kept; the command line would swallow the words of a `KeyboardInterrupt`."""


@takes_groups
def fleet(
    fleet: Fleet,
    reading: Reading,
    channels: Channels,
    excitation: Excitation,
    fitting: Fitting,
    diagnosing: Diagnosing,
    talk: Talk,
) -> None:
    """Identify or diagnose every one of many records, and write tables and a page of all of them.

    What is done is kept in --out; a second call does the rest. Without --scheduler, workers of this machine start by
    themselves.
    """
    from ..report import terminal
    from . import files

    files.check_holdout(channels)
    files.check_places(fleet.json)
    _check(fleet, channels, diagnosing)
    from .environment import prepare

    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("starting")
        prepare(verbose=talk.verbose, quiet=talk.quiet)
        from ..fleets import fleet as carry_out
        from ..fleets.run import summary_document

        programs = None if fleet.scheduler is not None else _programs()
        try:
            result = carry_out(
                fleet.files,
                inputs=_listed("--inputs", channels.inputs),
                outputs=_listed("--outputs", channels.outputs),
                out=fleet.out,
                task=fleet.task,
                scheduler=fleet.scheduler,
                workers=fleet.workers,
                reading=_reading(reading, channels),
                fitting=_fitting(fleet.task, channels, excitation, fitting, diagnosing),
                machine=fleet.machine,
                covariates=words(fleet.covariates),
                when_column=fleet.when_column,
                pages=not fleet.no_pages,
                programs=programs,
                again=fleet.again,
                progress=progress,
            )
        except KeyboardInterrupt as stopped:
            raise Interrupted(f"interrupted; {stopped}" if str(stopped) else "interrupted") from None
    finish(summary_document(result), lambda out, _: out.print(repr(result), soft_wrap=True), talk, fleet.json, {}, [])


def _programs():
    """Folder of what is compiled, which workers share with the command; None where it has none."""
    from ..numerics.programs.kept_files import NotPrivate
    from .environment import user_cache

    try:
        return user_cache("xla")
    except NotPrivate:
        return None


def _check(fleet: Fleet, channels: Channels, diagnosing: Diagnosing) -> None:
    """Raise `ValueError` for options that are about one record."""
    for option, given in (
        ("--validation", channels.validation),
        ("--model", diagnosing.model),
        ("--experiment", diagnosing.experiment),
    ):
        if given is not None:
            raise ValueError(f"{option} is about one record; leave it out, or diagnose that record by itself.")
    if fleet.workers is not None and fleet.workers < 1:
        raise ValueError(f"--workers={fleet.workers} is no number of processes; give a whole number from 1.")
    if fleet.workers is not None and fleet.scheduler is not None:
        raise ValueError("--workers and --scheduler are both given; leave one out.")


def _listed(option: str, text: str) -> list[str]:
    found = words(text)
    if not found:
        raise ValueError(f"{option} is empty; name one or several columns, with commas between.")
    return found


def _reading(reading: Reading, channels: Channels) -> dict:
    """Keywords of `read_record`, those that are given."""
    found = {
        "time": reading.time,
        "sampling_time": reading.sampling_time,
        "scheduling": reading.scheduling,
        "delimiter": DELIMITERS.get(reading.delimiter, reading.delimiter),
        "decimal": reading.decimal,
        "input_units": None if reading.input_units is None else words(reading.input_units),
        "output_units": None if reading.output_units is None else words(reading.output_units),
        "hold": channels.hold,
        "measured": words(channels.measured),
    }
    return {name: value for name, value in found.items() if value is not None}


def _fitting(task: str, channels: Channels, excitation: Excitation, fitting: Fitting, diagnosing: Diagnosing) -> dict:
    """Keywords of `identify` or `diagnose`, those that differ from their defaults."""
    defaults = Excitation(), Fitting(), Diagnosing()
    found = subspace_options(excitation)
    usual = subspace_options(defaults[0])
    found |= {"structure": words(fitting.structure), "fix": fitting.fix, "noise": fitting.noise}
    usual |= {"structure": words(None), "fix": None, "noise": defaults[1].noise}
    found["holdout"], usual["holdout"] = channels.holdout, None
    if task == "diagnose":
        from .diagnosing import checked, ids

        checked(fitting, diagnosing)
        found |= {name: ids(f"--{name}", getattr(diagnosing, name)) for name in ("only", "exclude")}
        found |= {name: getattr(diagnosing, name) for name in ("max_effects", "budget", "seed")}
        usual |= {name: getattr(defaults[2], name) for name in ("only", "exclude", "max_effects", "budget", "seed")}
    else:
        found |= {"refine": not fitting.no_refine, "hidden": hidden_of(fitting.hidden)}
        usual |= {"refine": True, "hidden": 0}
    return {name: value for name, value in found.items() if value != usual[name]}
