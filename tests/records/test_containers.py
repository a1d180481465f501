"""Arrays by name to records: npz, mat, hdf5, parquet, data frames."""

import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from jaxgray.records import read_record

MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def columns(samples=50, step=0.01):
    rng = np.random.default_rng(0)
    return step * np.arange(samples), rng.standard_normal(samples), rng.standard_normal((samples, 2))


def arrays():
    t, u, y = columns()
    return {"t": t, "u": u, "y": y, "note": np.array("rig 7")}


def save_npz(path, data):
    np.savez(path, **data)


def save_mat(path, data):
    savemat(path, data)


def save_hdf5(path, data):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, value in data.items():
            file[name] = str(value) if value.dtype.kind == "U" else value


def save_mat73(path, data):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in data.items():
            if value.dtype.kind != "U":
                file[name] = np.atleast_2d(value) if value.ndim < 2 else value.T
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def save_parquet(path, data):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    flat = {"t": data["t"], "u": data["u"], "y[0]": data["y"][:, 0], "y[1]": data["y"][:, 1]}
    parquet.write_table(pyarrow.table(flat), path)


CONTAINERS = {
    "record.npz": save_npz,
    "record.mat": save_mat,
    "record73.mat": save_mat73,
    "record.h5": save_hdf5,
    "record.hdf5": save_hdf5,
    "record.parquet": save_parquet,
}


@pytest.mark.parametrize("name", CONTAINERS)
def test_containers_give_back_what_was_put_in(tmp_path, name):
    data = arrays()
    CONTAINERS[name](tmp_path / name, data)
    record = read_record(tmp_path / name, inputs="u", outputs=["y[1]", "y[0]"])
    np.testing.assert_array_equal(record.u[:, 0], data["u"])
    np.testing.assert_array_equal(record.y, data["y"][:, ::-1])
    assert record.output_names == ("y[1]", "y[0]") and record.sampling_time == 0.01
    with pytest.raises(ValueError, match="no column 'force'.*It has: t, u"):
        read_record(tmp_path / name, inputs="force", outputs="y[0]")


@pytest.mark.parametrize("name", ["record.npz", "record.mat", "record73.mat", "record.h5"])
def test_arrays_in_rows_a_sampling_time_and_lengths_that_differ(tmp_path, name):
    _, u, y = columns()
    data = {"u": u[None, :], "y": y.T, "sampling_time": np.array(0.004), "short": np.ones(20)}
    CONTAINERS[name](tmp_path / name, data)
    record = read_record(tmp_path / name, inputs="u", outputs=["y[0]", "y[1]"])
    np.testing.assert_array_equal(record.y, y)
    assert record.sampling_time == 0.004
    assert read_record(tmp_path / name, inputs="u", outputs="y[0]", sampling_time=1.0).sampling_time == 1.0
    with pytest.raises(ValueError, match="no column 'y'; it has several columns, say y.0., y.1."):
        read_record(tmp_path / name, inputs="u", outputs="y")
    with pytest.raises(ValueError, match="'short' of .* has 20 values and the first input has 50"):
        read_record(tmp_path / name, inputs="u", outputs="short")
    with pytest.raises(ValueError, match="'short' of .* has 20 values"):
        read_record(tmp_path / name, inputs="u", outputs="y[0]", time="short")


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_damaged_container_is_an_error_of_one_line(tmp_path, name):
    path = tmp_path / name
    CONTAINERS[name](path, arrays())
    for damaged in (path.read_bytes()[:200], b"not at all what the name says" * 20):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"{name} is no ") as caught:
            read_record(path, inputs="u", outputs="y[0]")
        assert "\n" not in str(caught.value)


def test_structures_groups_and_unit_attributes(tmp_path):
    _, u, y = columns()
    savemat(tmp_path / "a.mat", {"data": {"force": u, "motion": {"x": y[:, 0]}}})
    record = read_record(tmp_path / "a.mat", inputs="data.force", outputs="data.motion.x", sampling_time=0.1)
    np.testing.assert_array_equal(record.y[:, 0], y[:, 0])

    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rig/force"], file["rig/x"] = u, y[:, 0]
        file["rig/force"].attrs["units"], file["rig/x"].attrs["unit"] = "N", np.bytes_("mm")
    record = read_record(tmp_path / "a.h5", inputs="rig/force", outputs="rig/x", sampling_time=0.1)
    assert (record.input_units, record.output_units) == (("N",), ("mm",))


def test_objects_in_an_npz_are_never_unpickled(tmp_path):
    _, u, y = columns()
    np.savez(tmp_path / "a.npz", u=u, y=y[:, 0], extra=np.array([{}, None], dtype=object))
    record = read_record(tmp_path / "a.npz", inputs="u", outputs="y", sampling_time=0.1)
    np.testing.assert_array_equal(record.u[:, 0], u)
    with pytest.raises(ValueError, match="no column 'extra'"):
        read_record(tmp_path / "a.npz", inputs="extra", outputs="y", sampling_time=0.1)


@pytest.mark.parametrize("head", [b"[" * 1000 + b"\n", b"-" * 9000 + b"1\n"])
def test_a_head_that_is_too_much_for_a_parser_is_no_array(tmp_path, head):
    _, u, y = columns()
    np.savez(tmp_path / "a.npz", u=u, y=y[:, 0])
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("extra.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    record = read_record(tmp_path / "a.npz", inputs="u", outputs="y", sampling_time=0.1)
    np.testing.assert_array_equal(record.u[:, 0], u)
    with pytest.raises(ValueError, match="no column 'extra'"):
        read_record(tmp_path / "a.npz", inputs="extra", outputs="y", sampling_time=0.1)


@pytest.mark.parametrize("suffix, module, extra", [(".h5", "h5py", "hdf5"), (".parquet", "pyarrow", "parquet")])
def test_a_missing_extra_is_named(write, monkeypatch, suffix, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"needs {module}: pip install 'jaxgray\[{extra}\]'"):
        read_record(write("x", "record" + suffix), inputs="u", outputs="y")


class Frame:
    """The least that makes a data frame."""

    def __init__(self, **data):
        self.data, self.columns = data, list(data)

    def __getitem__(self, name):
        return self.data[name]


def test_anything_with_columns_is_a_data_frame():
    frame = Frame(time=[0.0, 0.5, 1.0], u=[1, 2, 3], y=[1.0, None, 3.0], word=["a", "b", "c"])
    record = read_record(frame, inputs="u", outputs="y")
    np.testing.assert_array_equal(record.y[:, 0], [1.0, np.nan, 3.0])
    assert record.sampling_time == 0.5
    with pytest.raises(ValueError, match="column 'word' of the data frame holds the text 'a' at sample 0"):
        read_record(frame, inputs="u", outputs="word")


def test_time_stamps_become_seconds():
    stamps = np.datetime64("2024-02-03T04:05:06") + np.arange(4) * np.timedelta64(20, "ms")
    record = read_record(Frame(time=stamps, u=np.arange(4.0), y=np.ones(4)), inputs="u", outputs="y")
    assert record.sampling_time == pytest.approx(0.02) and record.start_time == 0.0


def test_pandas_frames():
    pandas = pytest.importorskip("pandas")
    t, u, y = columns()
    frame = pandas.DataFrame({"t": t, "force [N]": u, "x": y[:, 0]})
    record = read_record(frame, inputs="force", outputs="x")
    np.testing.assert_array_equal(record.u[:, 0], u)
    assert record.input_units == ("N",)
    doubled = pandas.DataFrame(np.c_[t, u, u], columns=["t", "u", "u"])
    with pytest.raises(ValueError, match="the data frame has 2 columns called 'u'"):
        read_record(doubled, inputs="u", outputs="t", sampling_time=1.0)
