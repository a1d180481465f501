"""One record through every format and table: the same numbers, bit for bit where the format allows."""

import sys
import warnings

import h5py
import numpy as np
import pandas
import pyarrow
import pytest
import pyuff
import xarray
from pyarrow.parquet import write_table
from scipy.io import savemat

from jaxgray.records import Record, read_record

SAMPLES, H = 60, 0.008
RNG = np.random.default_rng(5)
T = H * np.arange(SAMPLES)
U = RNG.standard_normal(SAMPLES)
Y = RNG.standard_normal((SAMPLES, 2)) * 1e-3
ARRAYS = {"time": T, "force": U, "x1": Y[:, 0], "x2": Y[:, 1]}


def delimited(delimiter, decimal="."):
    def write(path):
        def row(cells):
            return delimiter.join(repr(float(cell)).replace(".", decimal) for cell in cells)

        headers = delimiter.join(["time [s]", "force [N]", "x1 [m]", "x2 [m]"])
        lines = ["# rig 7", headers, *map(row, zip(*ARRAYS.values()))]
        path.write_bytes(("\ufeff" + "\r\n".join(lines) + "\r\n").encode())

    return write


def npz(path):
    np.savez(path, **ARRAYS)


def npy(path):
    np.save(path, np.rec.fromarrays(list(ARRAYS.values()), names=list(ARRAYS)))


def mat(path):
    savemat(path, ARRAYS)


def mat73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in ARRAYS.items():
            file[name] = np.atleast_2d(value)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def hdf5(path):
    with h5py.File(path, "w") as file:
        for name, value in ARRAYS.items():
            file[name] = value


def parquet(path):
    write_table(pyarrow.table(ARRAYS), path)


FORMATS = {
    "comma.csv": delimited(","),
    "semicolon.csv": delimited(";"),
    "semicolon and decimal comma.csv": delimited(";", ","),
    "tab.tsv": delimited("\t"),
    "tab and decimal comma.txt": delimited("\t", ","),
    "blanks.dat": delimited("  "),
    "a.npz": npz,
    "a.npy": npy,
    "a.mat": mat,
    "73.mat": mat73,
    "a.h5": hdf5,
    "a.hdf5": hdf5,
    "a.parquet": parquet,
}


def same(record, **options):
    np.testing.assert_array_equal(record.u[:, 0], U)
    np.testing.assert_array_equal(record.y, Y)
    assert (record.sampling_time, record.start_time) == (H, 0.0)


@pytest.mark.parametrize("name", FORMATS)
def test_every_file_gives_the_same_record_bit_for_bit(tmp_path, name):
    path = tmp_path / name
    FORMATS[name](path)
    record = read_record(path, inputs="force", outputs=["x1", "x2"])
    same(record)
    assert (record.input_names, record.output_names) == (("force",), ("x1", "x2"))
    if "csv" in name:
        assert (record.input_units, record.output_units) == (("N",), ("m", "m"))


def test_a_plain_array_on_disc_is_mapped_and_its_columns_numbered(tmp_path):
    np.save(tmp_path / "a.npy", np.column_stack(list(ARRAYS.values())))
    same(read_record(tmp_path / "a.npy", time="data[0]", inputs="data[1]", outputs=["data[2]", "data[3]"]))
    (tmp_path / "b.npy").write_bytes(b"\x93NUMPY and no more")
    with pytest.raises(ValueError, match="b.npy is no npy array of numbers"):
        read_record(tmp_path / "b.npy", inputs="data[1]", outputs="data[2]")
    np.save(tmp_path / "c.npy", np.array([{}, None], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="c.npy is no npy array of numbers"):
        read_record(tmp_path / "c.npy", inputs="data[1]", outputs="data[2]")


def test_a_decimal_comma_where_the_comma_delimits_is_hinted_at(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('t,u,y\n0,1,"2,5"\n1,2,"3,5"\n')
    with pytest.raises(ValueError, match="holds the text '2,5' at line 2.*say that the decimal is a comma"):
        read_record(path, inputs="u", outputs="y")
    np.testing.assert_array_equal(read_record(path, inputs="u", outputs="y", decimal=",").y[:, 0], [2.5, 3.5])


def test_dictionaries_of_arrays():
    same(read_record(ARRAYS, inputs="force", outputs=["x1", "x2"]))
    both = {"u": U, "y": Y, "sampling_time": H}
    same(read_record(both, inputs="u", outputs=["y[0]", "y[1]"]))
    with pytest.raises(ValueError, match="the dictionary has no column 'v'. It has: u, y"):
        read_record(both, inputs="v", outputs="y[0]")


@pytest.mark.parametrize("what", [3, [1.0], None, (U, Y)])
def test_anything_else_in_memory_is_refused(what):
    with pytest.raises(ValueError, match="path is of type .*; give the path of a file, a data frame, an xarray"):
        read_record(what, inputs="u", outputs="y")


def test_a_record_is_no_file():
    with pytest.raises(ValueError, match="path is a Record already"):
        read_record(Record(U, Y, H), inputs="u1", outputs="y1")


class TestPandas:
    def frame(self, index=None, **changes):
        columns = {"force [N]": U, "x1": Y[:, 0], "x2": Y[:, 1]} | changes
        return pandas.DataFrame(columns, index=index)

    def read(self, frame, **options):
        return read_record(frame, inputs="force", outputs=["x1", "x2"], **options)

    def test_time_as_a_column(self):
        record = self.read(self.frame(time=T))
        same(record)
        assert record.input_units == ("N",)

    def test_time_as_the_index(self):
        same(self.read(self.frame(pandas.Index(T, name="time"))))
        same(self.read(self.frame(T), time="index"))
        with pytest.raises(ValueError, match="no column called t or time"):
            self.read(self.frame())
        assert self.read(self.frame(), sampling_time=0.5).sampling_time == 0.5

    @pytest.mark.parametrize("zone", [None, "Europe/Stockholm"])
    def test_time_stamps(self, zone):
        stamps = pandas.date_range("2024-03-31 00:59:59.9", periods=SAMPLES, freq="8ms", tz=zone)
        same(self.read(self.frame(stamps)))
        same(self.read(self.frame(time=stamps)))
        same(self.read(self.frame(pandas.TimedeltaIndex(stamps - stamps[0]))))

    def test_gaps_in_types_that_numpy_lacks(self):
        x = pandas.array([1, None, *range(2, SAMPLES)], dtype="Int64")
        record = self.read(self.frame(time=T, x1=x))
        np.testing.assert_array_equal(record.y[:3, 0], [1.0, np.nan, 2.0])


class TestXarray:
    def test_a_dataset(self):
        data = xarray.Dataset(
            {"force": ("time", U, {"units": "N"}), "motion": (("time", "side"), Y, {"unit": "m"}), "gain": 3.0},
            coords={"time": T, "side": ["left", "right"]},
        )
        record = read_record(data, inputs="force", outputs=["motion.left", "motion.right"])
        same(record)
        assert (record.input_units, record.output_units) == (("N",), ("m", "m"))
        with pytest.raises(ValueError, match="the dataset has no column 'motion.*It has: force, motion.left, motion.r"):
            read_record(data, inputs="force", outputs="motion")

    def test_time_stamps_and_numbered_columns_in_rows(self):
        stamps = np.datetime64("2024-02-03T04:05:06") + 8 * np.arange(SAMPLES) * np.timedelta64(1, "ms")
        data = xarray.Dataset({"force": ("time", U), "motion": (("side", "time"), Y.T)}, coords={"time": stamps})
        same(read_record(data, inputs="force", outputs=["motion[0]", "motion[1]"]))

    def test_arrays(self):
        channels = np.column_stack([U, Y])
        options = {"dims": ("sample", "channel"), "coords": {"channel": ["force", "x1", "x2"]}}
        array = xarray.DataArray(channels, attrs={"sampling_time": H}, **options)
        same(read_record(array, inputs="force", outputs=["x1", "x2"]))
        same(read_record(array.rename("run"), inputs="run.force", outputs=["run.x1", "run.x2"]))


class Measured:
    """What `nonlinear_benchmarks` hands out."""

    def __init__(self, u, y, sampling_time, name):
        self.u, self.y, self.sampling_time, self.name = u, y, sampling_time, name


def test_benchmark_records():
    same(read_record(Measured(U, Y, H, "rig"), inputs="u", outputs=["y[0]", "y[1]"]))
    same(read_record(Measured(U, Y, None, ""), inputs="u", outputs=["y[0]", "y[1]"], sampling_time=H))
    with pytest.raises(ValueError, match="the record rig has no column 'x'. It has: u, y"):
        read_record(Measured(U, Y, H, "rig"), inputs="x", outputs="y[0]")


def test_a_benchmark_from_local_files(tmp_path):
    """Its loaders take files that are there already: no network."""
    benchmarks = pytest.importorskip("nonlinear_benchmarks")
    (tmp_path / "EMPS").mkdir()
    (tmp_path / "EMPS" / "EMPS.zip").write_bytes(b"")
    for k, name in enumerate(("DATA_EMPS", "DATA_EMPS_PULSES")):
        savemat(
            tmp_path / "EMPS" / f"{name}.mat", {"qm": Y[:, k : k + 1], "qg": 0 * Y, "t": T[:, None], "vir": U[:, None]}
        )
    for k, one in enumerate(benchmarks.EMPS(dir_placement=str(tmp_path))):
        record = read_record(one, inputs="u", outputs="y")
        np.testing.assert_array_equal(np.column_stack([record.u, record.y]), np.column_stack([U, Y[:, k]]))
        assert record.sampling_time == H


class TestUniversal:
    def signal(self, values, kind, node, direction, unit, *, binary=0, step=H, function=1):
        return pyuff.prepare_58(
            binary=binary,
            func_type=function,
            orddenom_spec_data_type=0,
            rsp_node=node,
            rsp_dir=direction,
            ref_node=1,
            ref_dir=3,
            ordinate_spec_data_type=kind,
            ordinate_axis_units_lab=unit,
            abscissa_spec_data_type=17,
            abscissa_axis_units_lab="s",
            data=values,
            x=step * np.arange(len(values)),
            abscissa_min=0.0,
            abscissa_inc=step,
            abscissa_spacing=1,
            num_pts=len(values),
        )

    def write(self, path, *signals):
        # Its writer leaves files open, and empties a binary one that it opens anew.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            pyuff.UFF(str(path)).write_sets(list(signals), mode="add")
        return path

    def three(self, **options):
        return [
            self.signal(U, 13, 1, 3, "N", **options),
            self.signal(Y[:, 0], 12, 1, 3, "m/s^2", **options),
            self.signal(Y[:, 1], 12, 12, -4, "m/s^2", **options),
        ]

    @pytest.mark.parametrize("suffix", ["uff", "unv"])
    def test_binary_bit_for_bit(self, tmp_path, suffix):
        path = self.write(tmp_path / f"a.{suffix}", *self.three(binary=1))
        record = read_record(path, inputs="force 1+Z", outputs=["acceleration 1+Z", "acceleration 12-RX"])
        same(record)
        assert (record.input_units, record.output_units) == (("N",), ("m/s^2", "m/s^2"))

    def test_text_to_its_twelve_digits(self, tmp_path):
        other = self.signal(U + 0j, 12, 1, 3, "", function=4)
        path = self.write(tmp_path / "a.uff", other, *self.three(), self.signal(Y[:, 1], 12, 1, 3, ""))
        record = read_record(
            path, inputs="force 1+Z", outputs=["acceleration 1+Z", "acceleration 12-RX", "acceleration 1+Z #2"]
        )
        np.testing.assert_allclose(record.u[:, 0], U, rtol=1e-11)
        np.testing.assert_allclose(record.y, Y[:, [0, 1, 1]], rtol=1e-11)
        assert record.sampling_time == H

    def test_wrong_files_are_an_error_of_one_line(self, tmp_path, monkeypatch):
        def fails(path, match, error=ValueError):
            with pytest.raises(error, match=match) as caught:
                read_record(path, inputs="force 1+Z", outputs="acceleration 1+Z")
            assert "\n" not in str(caught.value)

        whole = self.write(tmp_path / "a.uff", *self.three())
        junk = tmp_path / "junk.uff"
        junk.write_bytes(b"no universal file at all\n" * 9)
        fails(junk, "junk.uff is no universal file with time signals")
        text = whole.read_text().splitlines(keepends=True)
        (tmp_path / "cut.uff").write_text("".join([*text[:16], *text[20:]]))
        fails(tmp_path / "cut.uff", "cut.uff is damaged: 'force 1.Z' has .* of 60 values")
        (tmp_path / "bad.uff").write_text("".join(text).replace("e-01", "q-01"))
        fails(tmp_path / "bad.uff", "bad.uff is no universal file")
        spectrum = self.write(tmp_path / "frf.uff", self.signal(U + 0j, 12, 1, 3, "", function=4))
        fails(spectrum, "no universal file with time signals .*it has 1 other functions")
        later = self.signal(Y[:, 0], 12, 1, 3, "", step=2 * H)
        fails(self.write(tmp_path / "b.uff", self.three()[0], later), "have different time axes; split the file")
        with pytest.raises(ValueError, match="has no column 'x'. It has: force 1.Z, acceleration 1.Z, acc.*, time"):
            read_record(whole, inputs="x", outputs="force 1+Z")
        monkeypatch.setitem(sys.modules, "pyuff", None)
        fails(whole, r"a.uff needs pyuff: pip install 'jaxgray\[uff\]'", ImportError)
