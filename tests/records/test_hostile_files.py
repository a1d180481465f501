"""Files made to do harm: each is a record or one error of one line, soon, and in little memory."""

import io
import json
import os
import pickle
import random
import resource
import socket
import struct
import subprocess
import sys
import warnings
import zipfile
import zlib

import h5py
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from scipy.io import savemat

from jaxgray.records import RecordWarning, read_record
from jaxgray.records.readers.chunks import count_rows, read_chunks, read_rows
from jaxgray.records.readers.table import split_unit

CHANNELS = {"inputs": "u", "outputs": "y", "sampling_time": 0.1}
SERIES = np.sin(np.arange(50.0))


def refused(path, match, **channels):
    with pytest.raises((ValueError, ImportError), match=match) as caught:
        read_record(path, **(channels or CHANNELS))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 3000


class Trap:
    """What a pickle would run."""

    def __reduce__(self):
        return os.mkdir, ("trapped",)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder in which nothing new may appear."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not (tmp_path / "trapped").exists()


def npy_declaring(shape: str) -> bytes:
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + SERIES.tobytes()


def test_pickles_are_not_run(folder):
    objects = np.array([Trap(), Trap()], dtype=object)
    np.save(folder / "a.npy", objects, allow_pickle=True)
    refused(folder / "a.npy", "a.npy is no npy array of numbers")
    (folder / "b.npy").write_bytes(pickle.dumps(Trap()))
    refused(folder / "b.npy", "b.npy is no npy array of numbers")
    (folder / "c.npz").write_bytes(pickle.dumps(Trap()))
    refused(folder / "c.npz", "c.npz is no npz archive of numbers")
    np.savez(folder / "d.npz", u=SERIES, y=objects)
    refused(folder / "d.npz", "d.npz has no column 'y'")
    with zipfile.ZipFile(folder / "e.npz", "w") as archive:
        archive.writestr("u", pickle.dumps(Trap()))
    refused(folder / "e.npz", "e.npz has no column 'u'")


def test_pipes_devices_sockets_and_folders_are_refused_at_once(folder):
    for suffix in (".csv", ".npy", ".npz", ".mat", ".h5", ".parquet", ".uff"):
        os.mkfifo(folder / f"pipe{suffix}")
        refused(folder / f"pipe{suffix}", "is no regular file")
        (folder / f"folder{suffix}").mkdir()
        refused(folder / f"folder{suffix}", "is a folder")
        (folder / f"device{suffix}").symlink_to("/dev/zero")
        refused(folder / f"device{suffix}", "is no regular file")
        (folder / f"loop{suffix}").symlink_to(f"loop{suffix}")
        refused(folder / f"loop{suffix}", "does not exist")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind("a.csv")
        refused(folder / "a.csv", "is no regular file")
    with pytest.raises(ValueError, match="is no regular file"):
        count_rows(folder / "pipe.npy", ["data[0]"])


@pytest.mark.parametrize(
    "shape", ["(10**12,)", "(1000000000000,)", "(3, 99999999999)", "(-1,)", "(50.0,)", "(0, 10000000000000000)"]
)
def test_shapes_that_the_file_cannot_hold(folder, shape):
    (folder / "a.npy").write_bytes(npy_declaring(shape))
    refused(folder / "a.npy", "a.npy", inputs="data", outputs="data[1]", sampling_time=0.1)
    with zipfile.ZipFile(folder / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("u.npy", npy_declaring(shape))
        archive.writestr("y.npy", npy_declaring("(50,)"))
    refused(folder / "a.npz", "a.npz")


def test_a_unit_that_is_no_text_any_more_is_left_out(folder):
    path = folder / "a.h5"
    with h5py.File(path, "w") as file:
        file["u"], file["y"] = SERIES, SERIES
        file["u"].attrs["units"] = "N"
    # A type of variable length: one bit tells texts from sequences, at whose elements the library crashed.
    content = path.read_bytes()
    path.write_bytes(content.replace(b"\x19\x01\x01", b"\x19\x00\x01"))
    assert content.count(b"\x19\x01\x01") == 1
    record = read_record(path, inputs="u", outputs="y", sampling_time=0.1)
    assert record.input_units == ("",)


def bombs(folder):
    """Files of a few kilobytes that declare, or expand to, gigabytes."""
    zeros = bytes(2**22)
    with h5py.File(folder / "sparse.h5", "w") as file:
        file.create_dataset("u", shape=(2**28,), dtype="f8", chunks=(2**20,), compression="gzip")
        file["y"] = SERIES
    with h5py.File(folder / "twice.h5", "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((2**22,))
        plan.set_deflate(9)
        plan.set_filter(h5py.h5z.FILTER_DEFLATE, h5py.h5z.FLAG_MANDATORY, (9,))
        space = h5py.h5s.create_simple((2**22,))
        u = h5py.h5d.create(file.id, b"u", h5py.h5t.NATIVE_INT8, space, plan)
        u.write_direct_chunk((0,), zlib.compress(zlib.compress(zeros, 9), 9))
        file["y"] = SERIES
    with h5py.File(folder / "scaled.h5", "w") as file:
        file.create_dataset("u", data=np.zeros(2**20, dtype="i8"), chunks=(2**20,), scaleoffset=0)
        file["y"] = SERIES
    table = pyarrow.table({"u": np.zeros(2**22), "y": np.zeros(2**22)})
    parquet.write_table(table, folder / "constant.parquet", data_page_size=2**30, max_rows_per_page=2**30)
    parquet.write_table(table.slice(0, 1000), folder / "brotli.parquet", compression="brotli")
    one = pyarrow.DictionaryArray.from_arrays(np.zeros(2_000, dtype="i4"), ["9" * 100_000])
    words = pyarrow.table({"u": one, "y": np.zeros(2_000)})
    parquet.write_table(words, folder / "words.parquet", compression="zstd", store_schema=False)
    stream = io.BytesIO()
    savemat(stream, {"u": np.zeros(2**20), "y": SERIES}, do_compression=True)
    (folder / "zeros.mat").write_bytes(stream.getvalue())
    for name, kind in (("bzip2.npz", zipfile.ZIP_BZIP2), ("lzma.npz", zipfile.ZIP_LZMA)):
        with zipfile.ZipFile(folder / name, "w", kind) as archive:
            archive.writestr("u.npy", npy_declaring(f"({2**22 // 8},)")[: -SERIES.nbytes] + zeros)
            archive.writestr("y.npy", npy_declaring("(50,)"))


GROWTH = """
import resource, sys, pathlib
import h5py, pyarrow.parquet
from jaxgray.records import read_record
resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    before = peak()
    try:
        read_record(path, inputs="u", outputs="y", sampling_time=0.1)
        said = "read"
    except ValueError as error:
        said = str(error)
    print(path.name, (peak() - before) // 1024, said, sep="|")
"""


def test_bombs_stay_small_and_are_explained(folder):
    bombs(folder)
    assert max(path.stat().st_size for path in folder.iterdir()) < 150_000
    run = subprocess.run([sys.executable, "-c", GROWTH, str(folder)], capture_output=True, text=True, check=True)
    told = {name: (int(grown), said) for name, grown, said in (line.split("|") for line in run.stdout.splitlines())}
    assert max(grown for grown, _ in told.values()) < 200, told
    for name, words in {
        "sparse.h5": "declares 2147483648 for 'u'",
        "twice.h5": "has the filters",
        "scaled.h5": "has the filters",
        "constant.parquet": "for 'u'; it is damaged or made to fill the memory",
        "brotli.parquet": "brotli",
        "words.parquet": "'u' of words.parquet is infinite",
        "zeros.mat": "values and the first input has",
        "bzip2.npz": "no column 'u'",
        "lzma.npz": "no column 'u'",
    }.items():
        assert words in told.pop(name)[1], run.stdout
    assert not told


def test_numbers_in_other_files_are_not_fetched(folder):
    (folder / "secret.bin").write_bytes(SERIES.tobytes())
    with h5py.File(folder / "secret.h5", "w") as file:
        file["u"] = SERIES
    with h5py.File(folder / "a.h5", "w") as file:
        file["y"] = SERIES
        file["u"] = h5py.ExternalLink(str(folder / "secret.h5"), "/u")
        file["soft"] = h5py.SoftLink("/u")
        file.create_dataset("outside", shape=(50,), dtype="f8", external=[(str(folder / "secret.bin"), 0, 400)])
        layout = h5py.VirtualLayout(shape=(50,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "u", shape=(50,))
        file.create_virtual_dataset("virtual", layout)
    for name, words in {
        "u": "has no column 'u'",
        "soft": "has no column 'soft'",
        "outside": "'outside' of a.h5 lies in other files",
        "virtual": "'virtual' of a.h5 lies in other files",
    }.items():
        refused(folder / "a.h5", words, inputs=name, outputs="y", sampling_time=0.1)
        with pytest.raises(ValueError, match="not in a.h5|lies in other files"):
            read_rows(folder / "a.h5", [name], 0, 10)
        with pytest.raises(ValueError, match="not in a.h5|lies in other files"):
            list(read_chunks(folder / "a.h5", [name]))


@pytest.mark.parametrize("kind", range(16))
def test_a_footer_of_parquet_that_declares_a_long_list(folder, kind):
    # Field 1 of the footer: a list of 2**31 elements of this kind.
    footer = bytes([0x19, 0xF0 | kind, 0xFF, 0xFF, 0xFF, 0xFF, 0x07])
    (folder / "a.parquet").write_bytes(b"PAR1" + footer + struct.pack("<I", len(footer)) + b"PAR1")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    refused(folder / "a.parquet", "a.parquet is no Parquet file")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_utime - before < 1.0


@pytest.mark.parametrize("version", ["earliest", "latest"])
def test_a_heap_without_an_end_costs_the_units_alone(folder, version):
    path = folder / "a.h5"
    with h5py.File(path, "w", libver=version) as file:
        file["u"], file["y"] = SERIES, SERIES
        file["u"].attrs["units"], file["y"].attrs["units"] = "N", np.bytes_("mm")
    assert read_record(path, **CHANNELS).input_units == ("N",)
    content = bytearray(path.read_bytes())
    place = content.index(b"GCOL")
    # One text of one letter, then what is free: HDF5 never comes to the end of nothing.
    free = place + 16 + 16 + 8
    assert content[free : free + 2] == b"\0\0" and any(content[free + 8 : free + 16])
    for size in (0, 1, 2**64 - 16):
        content[free + 8 : free + 16] = size.to_bytes(8, "little")
        path.write_bytes(content)
        record = read_record(path, **CHANNELS)
        assert (record.input_units, record.output_units) == (("",), ("mm",))


# In the latest version the length is under a checksum.
@pytest.mark.parametrize(("version", "place"), [("earliest", "length"), ("earliest", "heap"), ("latest", "heap")])
@pytest.mark.parametrize("block", [0, 512])
def test_a_unit_that_says_to_be_long_costs_no_memory(folder, version, place, block):
    # MATLAB begins its files with a block of its own.
    path = folder / "a.h5"
    with h5py.File(path, "w", libver=version, userblock_size=block) as file:
        file["u"], file["y"] = SERIES, SERIES
        file["u"].attrs["units"], file["y"].attrs["unit"] = "newton", ""
    assert read_record(path, **CHANNELS).input_units == ("newton",)
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL")
    # Length, heap and number of the text: 6 bytes in its first object.
    at = (
        content.index((6).to_bytes(4, "little") + (heap - block).to_bytes(8, "little"))
        if place == "length"
        else heap + 8
    )
    content[at : at + 4] = (2**29).to_bytes(4, "little")
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert read_record(path, **CHANNELS).input_units == ("",)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_what_nests_deep_ends_with_a_line(folder):
    # A structure of one field that holds the next, and so on.
    head = struct.pack("<IIQ", 6, 8, 2) + struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<II", 1, 0)
    head += struct.pack("<Ii", 5 | 4 << 16, 8) + struct.pack("<II", 1, 8) + b"a".ljust(8, b"\0")
    parts, size = [], 0
    for _ in range(100_000):
        size += len(head)
        parts.append(struct.pack("<II", 14, size) + head)
        size += 8
    content = b"".join(reversed(parts))
    for name, data in (
        ("a", content),
        ("b", struct.pack("<II", 15, len(zlib.compress(content))) + zlib.compress(content)),
    ):
        (folder / f"{name}.mat").write_bytes(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + data)
        refused(folder / f"{name}.mat", "has no column 'u'")
    (folder / "a.npy").write_bytes(npy_declaring("(" * 40 + "1" + ",)" * 40))
    refused(folder / "a.npy", "a.npy is no npy array")


HEADERS = {
    "blanks": "a" + " " * 12_000 + "b",
    "brackets": "a[" * 60_000,
    "round": "a (" * 40_000,
    "quotes": '"' * 99_999,
    "long name": "u" * 12_000,
}


@pytest.mark.parametrize("kind", HEADERS)
@pytest.mark.parametrize("delimiter", [",", " "])
def test_headers_that_are_long_are_read_in_short_time(folder, kind, delimiter):
    rows = "\n".join(delimiter.join("123") for _ in range(5))
    (folder / "a.csv").write_text(f"{HEADERS[kind]}{delimiter}u{delimiter}y\n{rows}\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    try:
        read_record(folder / "a.csv", **CHANNELS)
    except ValueError as error:
        assert len(str(error)) < 3000
    refused(folder / "a.csv", "a.csv", inputs="none", outputs="y", sampling_time=0.1)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_utime - before < 2.0


@pytest.mark.parametrize(
    "header", ["a[b]", "a (b) [N]", "a [ ]", "u[0]", "[N]", "a [N", "a N]", "a[b[c]]", "a]b]", "()", "a ()"]
)
def test_units_are_taken_from_headers_as_before(header):
    import re

    # The definition in words of one expression, which takes too long on headers made to do so.
    match = re.match(r"^(?P<name>.*?\S)\s*(?:\[(?P<a>[^\[\]]*)\]|\((?P<b>[^()]*)\))$", header)
    unit = None if match is None else (match["a"] if match["a"] is not None else match["b"]).strip()
    expected = (header, "") if match is None or unit.isdecimal() else (match["name"].strip(), unit)
    assert split_unit(header) == expected


def test_a_declared_delimiter_that_is_none(folder):
    for first in ("sep=", 'sep="', "sep=\t", "sep=;;"):
        (folder / "a.csv").write_text(f"{first}\nu;y\n1;2\n3;4\n")
        try:
            read_record(folder / "a.csv", **CHANNELS)
        except ValueError as error:
            assert "a.csv" in str(error)


@pytest.mark.parametrize("suffix", ["npy", "npz", "csv", "mat", "h5", "parquet"])
def test_damaged_bytes_are_a_record_or_a_line(folder, suffix):
    """A short form of `benchmarks/fuzz_readers.py`."""
    path = folder / f"a.{suffix}"
    if suffix == "npy":
        np.save(path, np.rec.fromarrays([SERIES, SERIES], names="u,y"))
    elif suffix == "npz":
        np.savez(path, u=SERIES, y=SERIES)
    elif suffix == "csv":
        path.write_text("u [N],y\n" + "\n".join(f"{x:.6f},{x:.6f}" for x in SERIES) + "\n")
    elif suffix == "mat":
        savemat(path, {"u": SERIES, "y": SERIES, "s": {"a": SERIES}})
    elif suffix == "h5":
        with h5py.File(path, "w") as file:
            file["u"], file["y"] = SERIES, SERIES
    else:
        parquet.write_table(pyarrow.table({"u": SERIES, "y": SERIES}), path)
    whole, draw, outcomes = path.read_bytes(), random.Random(suffix), set()
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(draw.randrange(1, 5)):
            data[draw.randrange(min(len(data), draw.choice((100, 10**6))))] = draw.randrange(256)
        path.write_bytes(data[: draw.choice((len(data), len(data), draw.randrange(1, len(data))))])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RecordWarning)
                read_record(path, **CHANNELS)
            outcomes.add("read")
        except ValueError as error:
            assert "\n" not in str(error)
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_chunks_of_damaged_files_are_a_line(folder):
    for name in ("a.parquet", "a.h5"):
        if name == "a.h5":
            with h5py.File(folder / name, "w") as file:
                file["u"] = SERIES
        else:
            parquet.write_table(pyarrow.table({"u": SERIES}), folder / name)
        whole = (folder / name).read_bytes()
        for damaged in (whole[:-20], b"PAR1" * 30, whole[:40] + b"\xff" * 100 + whole[140:]):
            (folder / name).write_bytes(damaged)
            for read in (lambda p: list(read_chunks(p, ["u"])), lambda p: read_rows(p, ["u"], 0, 9)):
                try:
                    read(folder / name)
                except ValueError as error:
                    assert name in str(error) and "\n" not in str(error)


def test_json_of_a_model_that_nests_deep_or_has_huge_numbers(folder):
    from jaxgray.report.documents import export

    good = {"mass": [[2.0]], "damping": [[1.0]], "stiffness": [[9.0]]}
    for key, value, words in (
        ("mass", [[10**400]], "mass is not a matrix of numbers"),
        ("hidden", 10**400, "hidden is"),
        ("base", {"kind": ["displacement"], "direction": [[1.0]]}, "base is"),
        ("effects", [{"effect": ["x"], "location": "y1", "parameters": {}}], "effects: effect, location"),
        ("effects", [{"effect": "cubic_stiffness", "location": "y1", "parameters": {"k3": 10**400}}], "k3"),
        ("measured", ["displacement"] * 5000, "measured"),
    ):
        (folder / "a.json").write_text(json.dumps(good | {key: value}))
        with pytest.raises(ValueError, match=words) as caught:
            export.load(folder / "a.json")
        assert len(str(caught.value)) < 3000
    (folder / "a.json").write_text('{"model":' * 100_000 + "1" + "}" * 100_000)
    with pytest.raises(ValueError, match="not JSON that can be read"):
        export.load(folder / "a.json")
    os.mkfifo(folder / "pipe.json")
    with pytest.raises(ValueError, match="is no regular file"):
        export.load(folder / "pipe.json")
    np.savez(folder / "a.npz", mass=np.array([Trap()], dtype=object), damping=[[1.0]], stiffness=[[1.0]])
    with pytest.raises(ValueError, match="mass missing"):
        export.load(folder / "a.npz")
