"""Malformed files through every reader: a record, a model, or one error of one line.

Valid files are damaged (bits, blocks, lengths, numbers in headers, cuts) and read as a user's file would be. A batch
runs in a process of its own with bounded memory, so that a library that crashes is seen and counted. Input k of a
reader is made of the seed, the reader and k alone: `--first K --count 1` makes it again, `--keep DIR` keeps its file.
"""

import argparse
import dataclasses
import io
import json
import mmap
import os
import pathlib
import random
import re
import resource
import signal
import struct
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib

import numpy as np

from jaxgray.records import RecordWarning, read_record
from jaxgray.records.readers.limits import Refused

SLOW = 5.0
"""Seconds of processor time that no input may take."""
STUCK = 20.0
"""Seconds without a step after which a process is given up."""
LOOK = 0.02
"""Seconds between two looks at a process."""
MEMORY = 2**30
"""Bytes that a process may ask for beyond what it begins with."""
GROWTH = 2**28
"""Bytes by which a batch may grow in memory."""
BATCH = 5000
UNREADABLE = 98
"""Exit code of a process that cannot read the valid files."""
MOST_CRASHES = 50
"""In a batch; more say that the fault is elsewhere."""
LONGEST = 3000
"""Letters of a message."""
OUT_OF_MEMORY = re.compile("Unable to allocate|MemoryError|malloc|out of memory|bad_alloc|allocation failed")
SAMPLES = 40
HUGE = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**64 - 1)
WORDS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"9" * 30,
    b"9" * 400,
    b"1e-400",
    b"\0",
    b"\n",
    b'"',
    b"[",
    b"{",
    b"#",
    b"\xff\xfe",
)
NUMBERS = (b"0", b"-1", b"1", b"99999999", b"2147483648", b"9223372036854775807", b"9" * 25, b"1" * 5000, b"1e999")


def columns(rng):
    """Time, an input and two outputs."""
    return {
        "t": 0.01 * np.arange(SAMPLES),
        "u": rng.standard_normal(SAMPLES),
        "y": rng.standard_normal((SAMPLES, 2)),
        "sampling_time": np.array(0.01),
    }


def text_seeds(rng):
    data = columns(rng)
    rows = np.column_stack([data["t"], data["u"], data["y"]]).tolist()
    for delimiter, decimal, coding in (
        (",", ".", "utf-8"),
        (";", ",", "utf-16"),
        ("\t", ".", "latin-1"),
        (" ", ".", "utf-8"),
    ):
        lines = ["# rig 7", delimiter.join(["t", "u[N]", "y1(mm)", "y2"])]
        lines += [delimiter.join(f"{cell:.6g}".replace(".", decimal) for cell in row) for row in rows]
        yield ("\n".join(lines) + "\n").encode(coding)
    yield ("sep=;\n" + '"t";"u";"y1";"y2"\n' + "\n".join(";".join(map(repr, row)) for row in rows)).encode()


def npy_bytes(array, **options):
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def npz_seeds(rng):
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, **columns(rng), note=np.array("rig 7"), extra=np.array([{}, None], dtype=object))
        yield stream.getvalue()


def npy_seeds(rng):
    data = columns(rng)
    table = np.column_stack([data["t"], data["u"], data["y"]])
    yield npy_bytes(table)
    yield npy_bytes(np.asfortranarray(table.astype(">f4")))
    yield npy_bytes(np.rec.fromarrays([*table.T], names="t,u,y1,y2"))
    yield npy_bytes(np.rec.fromarrays([np.arange(SAMPLES).astype("M8[ms]"), *table.T[1:]], names="t,u,y1,y2"))


def mat_seeds(rng):
    from scipy.io import savemat

    data = columns(rng) | {"note": "rig 7", "cell": np.array([{}, 3], dtype=object)}
    nested = {"t": data["t"], "u": data["u"], "y": data["y"], "s": {"a": {"b": data["u"]}, "c": "text"}}
    for content, options in (
        (data, {}),
        (data, {"do_compression": True}),
        (nested, {}),
        (columns(rng), {"format": "4"}),
    ):
        stream = io.BytesIO()
        savemat(stream, content, **options)
        yield stream.getvalue()


def hdf5_seeds(rng, matlab=False):
    import h5py

    data = columns(rng)
    for version in ("earliest", "latest"):
        for options in ({}, {"chunks": True, "compression": "gzip", "shuffle": True, "fletcher32": True}):
            stream = io.BytesIO()
            with h5py.File(stream, "w", libver=version, userblock_size=512 if matlab else 0) as file:
                for name, value in data.items():
                    value = np.atleast_2d(value).T if matlab and value.ndim < 2 else value
                    file.create_dataset(name, data=value.T if matlab else value, **(options if value.ndim else {}))
                file["u"].attrs["units"] = "N"
                file.create_group("g")["v"] = data["u"]
                file["link"] = h5py.SoftLink("/u")
                file["far"] = h5py.ExternalLink("other.h5", "/u")
            content = bytearray(stream.getvalue())
            if matlab:
                content[:128] = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
            yield bytes(content)


def mat73_seeds(rng):
    return hdf5_seeds(rng, matlab=True)


def parquet_seeds(rng):
    import pyarrow
    from pyarrow import parquet

    data = columns(rng)
    table = {
        "t": data["t"],
        "u": data["u"].astype("f4"),
        "y1": data["y"][:, 0],
        "y2": [str(v) for v in data["y"][:, 1]],
    }
    for options in (
        {"compression": "none", "use_dictionary": False},
        {"compression": "snappy"},
        {"compression": "gzip", "row_group_size": 16, "data_page_version": "2.0"},
        {"compression": "zstd", "use_byte_stream_split": ["u"], "use_dictionary": ["y2"]},
    ):
        stream = io.BytesIO()
        parquet.write_table(pyarrow.table(table), stream, **options)
        yield stream.getvalue()


def uff_seeds(rng):
    import pyuff

    data = columns(rng)
    signals = ((13, 3, data["u"], "N"), (12, 3, data["y"][:, 0], "m/s^2"), (12, -1, data["y"][:, 1], "m/s^2"))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for binary in (0, 1):
            path = pathlib.Path(folder) / f"{binary}.uff"
            sets = [
                pyuff.prepare_58(
                    binary=binary,
                    func_type=1,
                    rsp_node=1,
                    rsp_dir=direction,
                    ref_node=1,
                    ref_dir=3,
                    ordinate_spec_data_type=kind,
                    orddenom_spec_data_type=0,
                    ordinate_axis_units_lab=unit,
                    abscissa_spec_data_type=17,
                    abscissa_axis_units_lab="s",
                    data=values,
                    x=data["t"],
                    abscissa_min=0.0,
                    abscissa_inc=0.01,
                    abscissa_spacing=1,
                    num_pts=SAMPLES,
                )
                for kind, direction, values, unit in signals
            ]
            pyuff.UFF(str(path)).write_sets(sets, mode="add")
            yield path.read_bytes()


def model_documents():
    """Models as `save` writes them, and documents that hold one as results do."""
    matrices = {
        "mass": [[5.0, -1.0], [-1.0, 1.0]],
        "damping": [[5.0, 0.0], [0.0, 1.0]],
        "stiffness": [[100.0, -5.0], [-5.0, 9.0]],
    }
    texts = {"measured": ["displacement", "velocity"], "input_names": ["u1", "u2"], "output_names": ["y1", "y2"]}
    texts |= {"input_units": ["N", "N"], "output_units": ["m", "m/s"]}
    effects = [
        {"effect": "coulomb_friction", "location": "y1", "parameters": {"Fc": 0.3, "eps": 1e-3}},
        {"effect": "cubic_stiffness", "location": "y1-y2", "parameters": {"k3": 1e4}},
    ]
    records = {"estimation": [{"sampling_time": 0.01, "hold": "zero", "samples": 40}], "validation": []}
    base = {"kind": "acceleration", "direction": [[1.0], [1.0]], "relative": True}
    one = {name: texts[name][:1] for name in ("input_names", "input_units")}
    hidden = {"output_names": ["y1"], "output_units": ["m"], "measured": ["displacement"], "hidden": ["h1"]}
    yield {"schema": "jaxgray/model/1", **matrices, "input_map": [[1.0, 0.0], [0.0, 1.0]], **texts, "effects": effects}
    yield {"schema": "jaxgray/model/1", **matrices, **texts, **one, "base": base}
    yield {"schema": "jaxgray/model/1", **matrices, **one, "input_map": [[1.0], [0.0]], **hidden}
    identified = {
        "schema": "jaxgray/identification/1",
        "records": records,
        "model": matrices | texts | {"standard_errors": None},
    }
    yield identified
    extended = {"model": matrices | texts | {"effects": effects}, "excess": 1.0}
    yield {"schema": "jaxgray/diagnosis/1", "records": records, "baseline": identified, "extended": extended}


def json_seeds(rng):
    return (json.dumps(one).encode() for one in model_documents())


def model_npz_seeds(rng):
    for document in list(model_documents())[:3]:
        base = document.pop("base", {})
        flat = document | {f"base_{key}": value for key, value in base.items()}
        if "effects" in flat:
            flat["effects"] = json.dumps(flat["effects"])
        stream = io.BytesIO()
        np.savez(stream, **{key: np.asarray(value) for key, value in flat.items()})
        yield stream.getvalue()


def damaged(draw: random.Random, content: bytes, others: list[bytes], depth: int = 0) -> bytes:
    """One to four changes anywhere, with a preference for the beginning and the end, where headers are."""
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        if not data:
            return bytes(draw.randbytes(draw.randrange(200)))
        region = draw.random()
        if region < 0.4:
            place = draw.randrange(min(len(data), 300))
        elif region < 0.6:
            place = len(data) - 1 - draw.randrange(min(len(data), 300))
        else:
            place = draw.randrange(len(data))
        kind = draw.randrange(12)
        if kind <= 1:
            for _ in range(draw.choice((1, 2, 8))):
                data[(place + draw.randrange(16)) % len(data)] ^= 1 << draw.randrange(8)
        elif kind == 2:
            data[place] = draw.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, draw.randrange(256)))
        elif kind == 3:
            size = draw.choice((2, 4, 8))
            number = draw.choice(HUGE) & (2 ** (8 * size) - 1)
            place -= place % draw.choice((1, 4))
            data[place : place + size] = number.to_bytes(size, draw.choice(("little", "big")))
        elif kind == 4:
            del data[place:]
        elif kind == 5:
            del data[place : place + draw.choice((1, 4, 8, 64))]
        elif kind == 6:
            data[place:place] = draw.randbytes(draw.choice((1, 4, 8, 64, 1000)))
        elif kind == 7:
            block = bytes(data[place : place + draw.choice((4, 16, 256))])
            data[place:place] = block * draw.choice((1, 2, 40))
        elif kind == 8:
            other = draw.choice(others)
            start = draw.randrange(len(other))
            data[place : place + draw.choice((0, 32))] = other[start : start + draw.choice((8, 64, 512))]
        elif kind == 9:
            data[place : place + draw.choice((0, 1, 8))] = draw.choice(WORDS)
        elif kind == 10:
            data = _number_replaced(draw, data, place)
        else:
            data[place:place] = draw.choice((b"[", b"(", b'{"a":', b"\0", b",", b" ", b"9")) * draw.choice(
                (10, 1000, 20000)
            )
    return bytes(data)


def _number_replaced(draw, data: bytearray, place: int) -> bytearray:
    """The next decimal number in text by a huge, negative or silly one."""
    digits = b"0123456789"
    while place < len(data) and data[place] not in digits:
        place += 1
    end = place
    while end < len(data) and data[end] in digits:
        end += 1
    given = draw.choice(
        (b"0", b"-1", b"1", b"99999999", b"2147483648", b"9223372036854775807", b"9" * 25, b"1" * 5000, b"1e999")
    )
    return data[:place] + given + data[end:]


def zip_damaged(draw, content, others, depth=0):
    """Inside a member, packed again with a check sum that fits; else from without."""
    if draw.random() < 0.3:
        return damaged(draw, content, others)
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as given, zipfile.ZipFile(stream, "w") as made:
        names = given.namelist()
        wanted = draw.choice(names)
        for name in names:
            member = given.read(name)
            if name == wanted:
                member = damaged(draw, member, [given.read(one) for one in names])
            kind = draw.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, given.getinfo(name).compress_type))
            made.writestr(name, member, kind)
    return stream.getvalue()


def mat_damaged(draw, content, others, depth=0):
    """Inside compressed elements, too."""
    place = 128
    if draw.random() < 0.5 and len(content) > 136 and struct.unpack_from("<I", content, place)[0] == 15:
        parts = [content[:128]]
        elements = []
        while place + 8 <= len(content):
            size = struct.unpack_from("<I", content, place + 4)[0]
            elements.append(zlib.decompress(content[place + 8 : place + 8 + size]))
            place += 8 + size
        wanted = draw.randrange(len(elements))
        elements[wanted] = damaged(draw, elements[wanted], elements)
        for one in elements:
            packed = zlib.compress(one)
            parts.append(struct.pack("<II", 15, len(packed)) + packed)
        return b"".join(parts)
    return damaged(draw, content, others)


NODES = (
    None, True, 0, -1, 3.5, 10**25, 10**400, -0.0, float("nan"), float("inf"), 1e308, 5e-324, "", "y1", "nan",
    "h1" * 4000, [], [[]], [1.0], [[1.0, 2.0], [3.0]], [["a"]], [[None]], {}, {"kind": ["x"]}, ["y1", "y1"], "base",
    [[1e308, -1e308], [-1e308, 1e308]], [[0.0, 0.0], [0.0, 0.0]], [[-1.0, 0.0], [0.0, -1.0]], [[1.0]], [[[1.0]]],
)  # fmt: skip
KEYS = (
    "mass",
    "hidden",
    "coordinates",
    "measured",
    "base",
    "effects",
    "model",
    "input_names",
    "output_names",
    "extended",
)


def json_damaged(draw, content, others, depth=0):
    """Other values at any place of the document, nesting without end, or bytes."""
    if draw.random() < 0.3:
        return damaged(draw, content, others)
    document = json.loads(content)
    for _ in range(draw.choice((1, 1, 2, 3))):
        places = []

        def visit(node, places=places):
            for key in node if isinstance(node, dict) else range(len(node)):
                places.append((node, key))
                if isinstance(node[key], dict | list):
                    visit(node[key])

        visit(document)
        node, key = draw.choice(places)
        kind = draw.randrange(8)
        if kind == 0:
            del node[key]
        elif kind == 1 and isinstance(node, dict):
            node[draw.choice(KEYS)] = json.loads(json.dumps(draw.choice(NODES)))
        elif kind == 2:
            other, name = draw.choice(places)
            node[key] = json.loads(json.dumps(other[name]))
        else:
            node[key] = json.loads(json.dumps(draw.choice(NODES)))
        if not document:
            break
    text = json.dumps(document)
    if draw.random() < 0.05:
        deep = draw.choice((50, 500, 900, 990, 5000, 100_000))
        opening, closing = draw.choice((("[", "]"), ('{"model":', "}"), ('{"a":', "}")))
        place = draw.choice([k for k, letter in enumerate(text) if letter in "[{"])
        text = text[:place] + opening * deep + draw.choice(("1", text)) + closing * deep + text[place + 1 :]
    return text.encode()


@dataclasses.dataclass(frozen=True)
class Reader:
    """A reader with its valid files, the damage that is done to them, and how they are read."""

    suffix: str
    seeds: object
    read: object
    damage: object = damaged


def as_record(*choices):
    """Read by one of several sets of arguments."""

    def read(path, draw):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecordWarning)
            return read_record(path, **draw.choice(choices))

    return read


def as_model(path, draw):
    """What `simulate`, `export` and `diagnose --model` do with a model file."""
    from jaxgray.cli.files import record_of
    from jaxgray.report.documents import export

    model = export.load(path)
    export.given(path)
    record_of(path)
    return model


NO_COLUMN = {"inputs": "x", "outputs": "y1"}
TEXT = as_record(
    {"inputs": "u", "outputs": ["y1", "y2"]}, {"inputs": "u", "outputs": "y1", "sampling_time": 0.01}, NO_COLUMN
)
ARRAYS = as_record(
    {"inputs": "u", "outputs": ["y[0]", "y[1]"]},
    {"inputs": "u", "outputs": "y[0]", "time": "t"},
    {"inputs": "u", "outputs": "y[1]", "sampling_time": 0.01},
    {"inputs": "x", "outputs": "y[1]"},
)
NPY = as_record(
    {"inputs": "u", "outputs": ["y1", "y2"]},
    {"inputs": "data[1]", "outputs": ["data[2]", "data[3]"], "time": "data[0]"},
    NO_COLUMN,
)
UFF = as_record(
    {"inputs": "force 1+Z", "outputs": ["acceleration 1+Z", "acceleration 1-X"]},
    {"inputs": "force 1+Z", "outputs": "acceleration 1+Z"},
    NO_COLUMN,
)

READERS = {
    "csv": Reader(".csv", text_seeds, TEXT),
    "tsv": Reader(".tsv", text_seeds, TEXT),
    "txt": Reader(".txt", text_seeds, TEXT),
    "npz": Reader(".npz", npz_seeds, ARRAYS, zip_damaged),
    "npy": Reader(".npy", npy_seeds, NPY),
    "mat5": Reader(".mat", mat_seeds, ARRAYS, mat_damaged),
    "mat73": Reader(".mat", mat73_seeds, ARRAYS),
    "hdf5": Reader(".h5", hdf5_seeds, ARRAYS),
    "parquet": Reader(".parquet", parquet_seeds, TEXT),
    "uff": Reader(".uff", uff_seeds, UFF),
    "model-json": Reader(".json", json_seeds, as_model, json_damaged),
    "model-npz": Reader(".npz", model_npz_seeds, as_model, zip_damaged),
}


def outcome_of(read, path, draw) -> tuple[str, str]:
    """What reading comes to, and of what is not permitted the trace."""
    try:
        read(path, draw)
    except (ValueError, ImportError) as error:
        text = str(error)
        if type(error) not in (ValueError, Refused, ImportError) or "\n" in text or len(text) > LONGEST:
            return "not one line", f"{type(error).__name__}: {text[:300]!r}"
        # Refused by the bound of this process, where jaxgray's own should have been before.
        return ("asked for memory", text) if OUT_OF_MEMORY.search(text) else ("error", "")
    except BaseException:
        return "uncaught", traceback.format_exc()
    return "read", ""


def child(name: str, seed: int, first: int, last: int, progress, report: int, folder: str, seeds) -> None:
    """Read inputs first to last; say on the way which one it is."""
    reader = READERS[name]
    path = pathlib.Path(folder) / f"x{reader.suffix}"
    for k, content in enumerate(seeds):
        path.write_bytes(content)
        # At least one way of reading suits each valid file, else the damage would not get far.
        if "read" not in {outcome_of(reader.read, path, random.Random(j))[0] for j in range(20)}:
            print(f"{name}: valid file {k} cannot be read", flush=True)
            os._exit(UNREADABLE)
    # After the first files, for which libraries take what they will need.
    size = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    counts: dict[str, int] = {}
    notes, slowest, largest = [], 0.0, 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(first, last):
        progress[:8] = k.to_bytes(8, "little")
        draw = random.Random(f"{seed} {name} {k}")
        content = reader.damage(draw, draw.choice(seeds), seeds)
        path.write_bytes(content)
        begun = time.process_time()
        outcome, note = outcome_of(reader.read, path, draw)
        took = time.process_time() - begun
        if took > SLOW:
            outcome, note = "slow", f"{took:.1f} s"
        slowest = max(slowest, took)
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if 1024 * (after - before) > GROWTH:
            outcome, note = "memory", f"grew by {(after - before) // 1024} MB on a file of {len(content)} bytes"
        largest, before = max(largest, 1024 * (after - before)), max(before, after)
        counts[outcome] = counts.get(outcome, 0) + 1
        if note and (outcome != "asked for memory" or counts[outcome] < 3) and len(notes) < 20:
            notes.append((k, outcome, note))
    os.write(report, json.dumps([counts, notes, slowest, largest]).encode())


def batch(name, seed, first, last, folder, seeds) -> tuple[dict, list, float, int]:
    """One batch in a process of its own; after a crash the rest goes on in another."""
    counts, notes, slowest, largest = {}, [], 0.0, 0
    while first < last:
        progress = mmap.mmap(-1, 8)
        progress[:8] = first.to_bytes(8, "little")
        reading, writing = os.pipe()
        process = os.fork()
        if process == 0:
            try:
                child(name, seed, first, last, progress, writing, folder, seeds)
                os._exit(0)
            except BaseException:
                traceback.print_exc()
                os._exit(99)
        os.close(writing)
        seen, looks, stuck = first, 0, False
        while (ended := os.waitpid(process, os.WNOHANG))[0] == 0:
            time.sleep(LOOK)
            at = int.from_bytes(progress[:8], "little")
            # Counted, not timed, so that a campaign can be stopped and go on.
            seen, looks = at, looks + 1 if at == seen else 0
            if looks * LOOK > STUCK:
                stuck = True
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)
                break
        if not stuck and os.waitstatus_to_exitcode(ended[1]) == UNREADABLE:
            raise SystemExit(1)
        with os.fdopen(reading, "rb") as stream:
            told = stream.read()
        at = int.from_bytes(progress[:8], "little")
        if told:
            found, more, slow, large = json.loads(told)
            for key, count in found.items():
                counts[key] = counts.get(key, 0) + count
            return counts, notes + more, max(slowest, slow), max(largest, large)
        # What came before the crash was read, but its outcomes went with the process.
        outcome = "stuck" if stuck else "crash"
        counts[outcome] = counts.get(outcome, 0) + 1
        counts["read or error, not told"] = counts.get("read or error, not told", 0) + at - first
        notes.append((at, outcome, ""))
        first = at + 1
        if len(notes) > MOST_CRASHES:
            raise SystemExit(f"{name}: given up after {len(notes)} crashes, the last at input {at}")
    return counts, notes, slowest, largest


def run(name: str, seed: int, first: int, count: int) -> dict:
    """All inputs of a reader."""
    seeds = list(READERS[name].seeds(np.random.default_rng(seed)))
    counts, notes, slowest, largest, begun = {}, [], 0.0, 0, time.perf_counter()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        for start in range(first, first + count, BATCH):
            found, more, slow, large = batch(name, seed, start, min(start + BATCH, first + count), folder, seeds)
            for key, number in found.items():
                counts[key] = counts.get(key, 0) + number
            notes += more
            slowest, largest = max(slowest, slow), max(largest, large)
    return {
        "reader": name,
        "inputs": count,
        "outcomes": counts,
        "slowest_s": round(slowest, 3),
        "largest_growth_mb": round(largest / 2**20, 1),
        "seconds": round(time.perf_counter() - begun, 1),
        "notes": notes[:50],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reader", action="append", choices=list(READERS), help="default all")
    parser.add_argument("--count", type=int, default=100_000, help="inputs a reader")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=pathlib.Path, help="write the inputs to this folder, and read nothing")
    parser.add_argument("--json", type=pathlib.Path)
    given = parser.parse_args()
    os.environ["JAX_ENABLE_X64"] = "1"
    warnings.simplefilter("error")
    # What a library warns of is its own affair; what jaxgray's arithmetic warns of is not.
    for module in ("h5py", "pyuff"):
        warnings.filterwarnings("ignore", module=module)
    results = []
    for name in given.reader or READERS:
        if given.keep:
            given.keep.mkdir(parents=True, exist_ok=True)
            seeds = list(READERS[name].seeds(np.random.default_rng(given.seed)))
            for k in range(given.first, given.first + given.count):
                draw = random.Random(f"{given.seed} {name} {k}")
                made = READERS[name].damage(draw, draw.choice(seeds), seeds)
                (given.keep / f"{name}-{k}{READERS[name].suffix}").write_bytes(made)
            continue
        results.append(run(name, given.seed, given.first, given.count))
        shown = {key: value for key, value in results[-1].items() if key != "notes"}
        print(json.dumps(shown), flush=True)
        for k, outcome, note in results[-1]["notes"][:6]:
            print(f"  input {k}: {outcome}\n    " + "\n    ".join(note.strip().splitlines()[-8:]), flush=True)
        if given.json:
            given.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
