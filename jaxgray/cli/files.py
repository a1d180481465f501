"""Reading records and models for the commands, and where results may go."""

import dataclasses
import warnings
from pathlib import Path

from ..records import Record, RecordWarning, read_record
from .arguments import Channels, Excitation, File, words

DELIMITERS = {"tab": "\t", "\\t": "\t", "space": " "}
"""Words for characters that are hard to type."""


def check_holdout(channels: Channels) -> None:
    """Raise `ValueError` where a held-out share is none, or comes with a validation file."""
    if channels.holdout is None:
        return
    if channels.validation is not None:
        raise ValueError("--validation and --holdout are both given; leave one out.")
    if not 0.0 < channels.holdout < 1.0:
        raise ValueError(f"--holdout={channels.holdout:g} is not a share; give a number between 0 and 1.")


def read(path: Path, file: File, channels, notes: list[str]) -> Record:
    """A record by the options; what the reader warns of is added to the notes.

    **Arguments:** `path`: which file; `file`: how it is read; `channels`: has `inputs`, `outputs`, `hold`,
    `measured`, as text with commas or as lists; `notes`: is added to.

    **Returns:** a `Record`.

    **Raises:** `ValueError` where file and options do not fit.
    """

    def listed(name: str):
        value = getattr(channels, name)
        if not isinstance(value, str):
            return list(value)
        parts = words(value)
        if not parts:
            raise ValueError(f"--{name} is empty; name one or several columns, with commas between.")
        return parts

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RecordWarning)
        record = read_record(
            path,
            inputs=listed("inputs"),
            outputs=listed("outputs"),
            time=file.time,
            sampling_time=file.sampling_time,
            hold=channels.hold,
            measured=listed("measured"),
            scheduling=file.scheduling,
            delimiter=DELIMITERS.get(file.delimiter, file.delimiter),
            decimal=file.decimal,
            input_units=None if file.input_units is None else words(file.input_units),
            output_units=None if file.output_units is None else words(file.output_units),
            own_times=file.own_times,
            also=file.also or (),
        )
    for one in caught:
        if issubclass(one.category, RecordWarning):
            notes.append(str(one.message))
        else:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return record


def simulated(columns: str | None, file: File, channels: Channels, notes: list[str]):
    """Columns of the record's file with the outputs of a simulation, samples × outputs; None for none."""
    if columns is None:
        return None
    if not words(columns):
        raise ValueError("--simulated is empty; name a column for every output, with commas between.")
    return read(file.file, file, dataclasses.replace(channels, outputs=columns), notes).y


def read_pair(file: File, channels: Channels, notes: list[str]) -> tuple[Record, Record | None]:
    """The record to fit, and the one to hold against it: another file, or the last part of the same."""
    check_holdout(channels)
    record = read(file.file, file, channels, notes)
    if channels.validation is not None:
        return record, read(channels.validation, file, channels, notes)
    if channels.holdout is not None:
        return record.split(channels.holdout)
    return record, None


def own_model(path: Path, record: Record, excitation: Excitation):
    """The user's own model, its channels those of the record.

    **Arguments:** `path`: JSON with at least mass, damping and stiffness, or one of our files; `record`: gives names
    and units, and with `excitation` the way the inputs enter where the file does not say.

    **Returns:** a `MechanicalModel`.

    **Raises:** `ValueError` where the file cannot be read or does not fit the record.
    """
    import dataclasses

    from ..identification.setup.options import drive_of
    from ..mechanics.linear import corrected
    from ..report.documents import export

    model, given = export.load(path), export.given(path)
    model = corrected(model)
    if model.hidden:
        raise ValueError(
            f"{path} has hidden coordinates ({', '.join(model.hidden)}), and a diagnosis judges models of measured "
            "ones; simulate it, or give a model with one coordinate per output."
        )
    if model.dofs != record.outputs:
        raise ValueError(f"{path}: the model has {model.dofs} coordinates, --outputs names {record.outputs}.")
    if given["input_map"] or given["base"]:
        if excitation.input_map is not None or excitation.excitation != "force":
            raise ValueError(f"{path} says how the inputs enter; leave out --input-map and --excitation.")
        drive = model.drive
    else:
        drive = drive_of(record, excitation.excitation, excitation.input_map, excitation.relative)
    if drive.inputs != record.inputs:
        raise ValueError(f"{path}: the model has {drive.inputs} inputs, --inputs names {record.inputs}.")
    for kind in ("input_names", "output_names"):
        mine, theirs = getattr(model, kind), getattr(record, kind)
        if given[kind] and mine != theirs and set(mine) == set(theirs):
            raise ValueError(f"{path} has {', '.join(mine)} in this order; name the columns in the same order.")
    for kind in ("input_units", "output_units"):
        for mine, theirs in zip(getattr(model, kind), getattr(record, kind)):
            if given[kind] and mine and theirs and mine != theirs:
                raise ValueError(f"{path} is in {mine}, the record in {theirs}; convert one of them.")
    if given["measured"] and model.measured != record.measured:
        wanted = ",".join(model.measured)
        raise ValueError(f"{path} is for other outputs than the record's: give --measured {wanted}.")
    names = {kind: getattr(record, kind) for kind in ("input_names", "output_names", "input_units", "output_units")}
    return dataclasses.replace(model, drive=drive, measured=record.measured, **names)


def simulator(text: str):
    """A function of a Python file, given as FILE.py:FUNCTION.

    **Raises:** `ValueError` where there is no such file or function, or the file does not run.
    """
    import importlib
    import sys

    path, _, name = text.rpartition(":")
    if not path or not name or not Path(path).is_file():
        raise ValueError(f"--simulator={text}: give a Python file and a function of it, such as robot.py:simulate.")
    # By its own name and in its folder, so that other processes find it.
    module = Path(path).stem
    sys.path.insert(0, str(Path(path).resolve().parent))
    try:
        made = importlib.import_module(module)
    except Exception as error:
        raise ValueError(f"--simulator={text}: {path} raised {type(error).__name__}: {error}") from error
    there = getattr(made, "__file__", None)
    if there is None or not Path(there).samefile(path):
        raise ValueError(f"--simulator={text}: Python has another module of the name {module}; rename the file.")
    if not callable(getattr(made, name, None)):
        raise ValueError(f"--simulator={text}: {path} has no function {name}.")
    return getattr(made, name)


def is_mujoco(text: str | None) -> bool:
    """Whether a simulator is a model of MuJoCo."""
    return text is not None and Path(text).suffix.lower() in (".xml", ".mjcf")


def is_fmu(text: str | None) -> bool:
    """Whether a simulator is a functional mock-up unit."""
    return text is not None and Path(text).suffix.lower() == ".fmu"


def other_program(text: str, record: Record, numbers: str | None, forces: str | None):
    """A model of MuJoCo, or a functional mock-up unit with the inputs that are `forces`, as a simulator of a record;
    `numbers`: NAME or NAME=X, with commas.

    **Raises:** `ValueError` where it does not fit the record, or its program is missing.
    """
    from ..simulators import FmuSimulator, MujocoSimulator

    def made(numbers):
        if is_mujoco(text):
            return MujocoSimulator(text, record, numbers)
        return FmuSimulator(text, record, words(forces or ""), numbers)

    try:
        given = None
        if numbers is not None:
            names = [part.partition("=")[0].strip() for part in words(numbers)]
            given = made(names).numbers
            given |= parameters(",".join(part for part in words(numbers) if "=" in part)) or {}
        return made(given)
    except ImportError as error:
        raise ValueError(f"--simulator={text}: {error}") from None


def parameters(text: str | None) -> dict[str, float] | None:
    """Numbers by name from NAME=X,…; None for none.

    **Raises:** `ValueError` for anything else.
    """
    if text is None:
        return None
    made = {}
    for part in filter(None, (one.strip() for one in text.split(","))):
        name, _, value = part.partition("=")
        try:
            made[name.strip()] = float(value)
        except ValueError:
            raise ValueError(
                f"--parameters: {part!r} is no number by name; write NAME=X, with commas between."
            ) from None
    return made


def record_of(path: Path) -> dict:
    """Sampling time and hold of the record that a model came from, where its file says so."""
    from ..report.documents.export import read_json

    records = read_json(path).get("records") if path.suffix.lower() == ".json" else None
    estimation = records.get("estimation") if isinstance(records, dict) else None
    first = estimation[0] if isinstance(estimation, list) and estimation else None
    return first if isinstance(first, dict) else {}


def check_places(*paths, read=(), folder: Path | None = None) -> None:
    """Raise `ValueError` for a file that could not be written, before time is spent on what goes into it.

    **Arguments:** `paths`: to be written, None for none; `read`: files that the command reads, which are not to be
    lost; `folder`: that is made where it is not there, default none.
    """
    from ..numerics.whole_files import check_place

    if folder is not None and folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is no folder; give another name.")
    kept = {Path(path).resolve() for path in read if path is not None}
    taken = set()
    for path in paths:
        if path is None or str(path) == "-":
            continue
        check_place(path)
        place = Path(path).resolve()
        if place in kept:
            raise ValueError(
                f"{path} is read by this command, and would be lost; give another name for what is written."
            )
        if place in taken:
            raise ValueError(f"{path} is asked for twice; give every file a name of its own.")
        taken.add(place)
