"""Delimited text to records: every header, every defect."""

import csv
import time
from pathlib import Path

import numpy as np
import pytest

from jaxgray.records import read_record
from jaxgray.records.readers.table import split_unit

MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def columns(samples=50, step=0.01):
    rng = np.random.default_rng(0)
    return step * np.arange(samples), rng.standard_normal(samples), rng.standard_normal((samples, 2))


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|", " ", ", ", "   "])
def test_the_delimiter_is_found(text, write, delimiter):
    t, u, y = columns()
    header = delimiter.join(["t [s]", "force [N]", "x1 (mm)", "x 2 [mrad/s]" if delimiter.strip() else "x2"])
    path = write(text(header, t, u, y[:, 0], y[:, 1], delimiter=delimiter))
    second = "x 2" if delimiter.strip() else "x2"
    record = read_record(path, inputs="force", outputs=["x1", second])
    np.testing.assert_array_equal(record.u[:, 0], u)
    np.testing.assert_array_equal(record.y, y)
    assert record.sampling_time == 0.01 and record.start_time == 0.0
    assert record.input_names == ("force",) and record.output_names == ("x1", second)
    assert record.input_units == ("N",) and record.output_units[0] == "mm"


@pytest.mark.parametrize("delimiter", [";", "\t", "|", " "])
def test_a_decimal_comma_is_found_where_the_comma_does_not_delimit(text, write, delimiter):
    t, u, y = columns()
    body = text("t u y", t, u, y[:, 0], delimiter=delimiter, form=lambda x: repr(x).replace(".", ","))
    record = read_record(write(body.replace("t u y", delimiter.join("tuy"))), inputs="u", outputs="y")
    np.testing.assert_array_equal(record.u[:, 0], u)
    np.testing.assert_array_equal(record.y[:, 0], y[:, 0])


def test_quoted_cells_with_a_decimal_comma(write):
    path = write('"t","u","y"\n"0,0","1,5","2"\n"0,5","2,5","3"\n')
    record = read_record(path, inputs="u", outputs="y", decimal=",")
    np.testing.assert_array_equal(record.u[:, 0], [1.5, 2.5])
    assert record.sampling_time == 0.5


@pytest.mark.parametrize(
    "content",
    [
        "# rig 7\n% again\nt,u,y\n0,1,2\n# half way\n1,3,4\n\n",
        "\ufefft,u,y\r\n0,1,2\r\n1,3,4\r\n",
        "sep=;\nt;u;y\n0;1;2\n1;3;4\n",
        "t,u,y,\n0,1,2,\n1,3,4,\n",
        "# t u y\n0 1 2\n1 3 4\n",
        "t,u,y\ns,N,mm\n0,1,2\n1,3,4\n",
        "t,u,y\n[s],[N],[mm]\n0,1,2\n1,3,4\n",
        "T,u,y\n0,1.0e0,+2\n1,3,4.\n",
        " t , u , y \n 0 , 1 , 2 \n 1 , 3 , 4 \n",
    ],
)
def test_what_loggers_and_spreadsheets_write(write, content):
    record = read_record(write(content), inputs="u", outputs="y")
    np.testing.assert_array_equal(record.u[:, 0], [1, 3])
    np.testing.assert_array_equal(record.y[:, 0], [2, 4])
    assert record.sampling_time == 1.0
    assert record.output_units == (("mm",) if "mm" in content else ("",))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_encodings(write, encoding):
    path = write("time [µs],u [°],y\n0,1,2\n250,3,4\n", encoding=encoding)
    record = read_record(path, inputs="u", outputs="y")
    assert record.input_units == ("°",) and record.sampling_time == pytest.approx(250e-6)


@pytest.mark.parametrize(
    "header, name, unit",
    [
        ("force [N]", "force", "N"),
        ("force (N)", "force", "N"),
        ("force[N/m^2]", "force", "N/m^2"),
        ("  force  ", "force", ""),
        ("u[0]", "u[0]", ""),
        ("torque [N m]", "torque", "N m"),
        ("a (b) [m]", "a (b)", "m"),
        ("force []", "force", ""),
        ("[N]", "[N]", ""),
        ("", "", ""),
    ],
)
def test_units_are_stripped_from_headers(header, name, unit):
    assert split_unit(header) == (name, unit)


def test_the_whole_header_tells_two_units_apart(write):
    path = write("t,f [N],f [kN],y\n0,1,2,3\n1,4,5,6\n")
    record = read_record(path, inputs="f [kN]", outputs="y")
    np.testing.assert_array_equal(record.u[:, 0], [2, 5])
    assert record.input_units == ("kN",)
    with pytest.raises(ValueError, match="inputs: record.csv has 2 columns called 'f'"):
        read_record(path, inputs="f", outputs="y")


@pytest.mark.parametrize("gap", ["", " ", "nan", "NaN", "NA", "n/a", "null"])
def test_missing_cells_are_missing_outputs_and_wrong_inputs(write, gap):
    path = write(f"t,u,y\n0,1,2\n1,2,{gap}\n2,3,4\n")
    record = read_record(path, inputs="u", outputs="y")
    np.testing.assert_array_equal(record.y[:, 0], [2, np.nan, 4])
    with pytest.raises(ValueError, match="inputs: column 'y' of record.csv has 1 missing values, the first at line 3"):
        read_record(path, inputs="y", outputs="u")


def test_units_scheduling_hold_and_measured_are_passed_on(write):
    path = write("t,u,y,p\n0,1,2,7\n1,3,4,8\n")
    record = read_record(
        path,
        inputs="u",
        outputs="y",
        scheduling="p",
        hold="linear",
        measured="acceleration",
        input_units="N",
        output_units=["m/s^2"],
    )
    np.testing.assert_array_equal(record.scheduling, [7, 8])
    assert (record.scheduling_name, record.hold, record.measured) == ("p", "linear", ("acceleration",))
    assert (record.input_units, record.output_units) == (("N",), ("m/s^2",))
    again = read_record(path, inputs="u", outputs="y", scheduling="y")
    np.testing.assert_array_equal(again.scheduling, [2, 4])


@pytest.mark.parametrize(
    "content, extra, match",
    [
        ("", {}, "record.csv is empty"),
        ("\n\n", {}, "record.csv is empty"),
        ("# only a comment\n", {}, "record.csv is empty"),
        ("t,u,y\n", {}, r"has 0 row\(s\) of numbers below its header"),
        ("t,u,y\n0,1,2\n", {}, r"has 1 row\(s\) of numbers"),
        ("0,1,2\n1,2,3\n2,3,4\n", {}, "starts with numbers .*add a header row"),
        ("t,force,y\n0,1,2\n1,2,3\n", {}, "inputs: record.csv has no column 'u'. It has: t, force, y"),
        ("t,u,y1\n0,1,2\n1,2,3\n", {}, "outputs: .* no column 'y'; did you mean 'y1'"),
        ("t,U,y\n0,1,2\n1,2,3\n", {}, "no column 'u'; did you mean 'U'"),
        ("t,u,y,y\n0,1,2,3\n1,2,3,4\n", {}, "2 columns called 'y'; give each a name of its own"),
        ("t,u,y\n0,1,2\n1,2,3\n2,fast,4\n", {}, "column 'u' of record.csv holds the text 'fast' at line 4"),
        ("# c\n\nt,u,y\n0,1,2\n1,2,3;5\n2,1,4\n", {}, "column 'y' .* the text '3;5' at line 5"),
        ("t,u,y\n0,1,2\n1,2\n2,3,4\n", {}, "has 2 cells at line 3 and 3 in the header"),
        ("t,u,y\n0,1,2\n1,2,3,4\n2,3,4\n", {}, "has 4 cells at line 3 and 3 in the header"),
        (
            "t,u,y\n0,1,2\n0,2,3\n1,3,4\n",
            {},
            r"does not increase at line 3 \(0 s, then 0 s\)",
        ),
        ("t,u,y\n0,1,2\n2,2,3\n1,3,4\n", {}, "does not increase at line 4"),
        ("t,u,y\n0,1,2\n,2,3\n1,3,4\n", {}, "time is missing at line 3"),
        ("t,u,y\n0,inf,2\n1,2,3\n", {}, "column 'u' of record.csv is infinite at line 2"),
        ("t,u,y\n0,1,2\n1,2,-inf\n", {}, "column 'y' of record.csv is infinite at line 3"),
        ("t,u,y\n0,1,2\n1,2,1e200\n", {}, r"column 'y' of record.csv reaches 1e\+200, beyond 1e\+150"),
        ("t,u,y\n0,1,nan\n1,2,\n", {}, "outputs: column 'y' of record.csv has no value at all"),
        ("x,u,y\n0,1,2\n1,2,3\n", {}, "no column called t or time; give time .* or sampling_time"),
        ("t,time,u,y\n0,0,1,2\n1,1,2,3\n", {}, "several time columns, 't', 'time'; say which with time"),
        ("t [furlong],u,y\n0,1,2\n1,2,3\n", {}, "time column 't' has the unit 'furlong'; give one of s,"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"time": "clock"}, "time: record.csv has no column 'clock'"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"time": "u"}, "column 'u' is in inputs and in time"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"outputs": "u"}, "column 'u' is in inputs and in outputs"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"outputs": ["y", "y"]}, "column 'y' is twice in outputs"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"outputs": []}, r"outputs is \[\]; give the name"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"sampling_time": 0.0}, "sampling_time is 0.0; give a positive number"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"time": "t", "sampling_time": 0.1}, "0.1 s and the time column says 1 s"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"time": "t", "sampling_time": 1.1}, "1.1 s and the time column says 1 s"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"time": "t", "sampling_time": 9.0}, "9 s and the time column says 1 s"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"scheduling": "p"}, "scheduling: record.csv has no column 'p'"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"decimal": ":"}, "decimal is ':'"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"decimal": ",", "delimiter": ","}, "decimal and delimiter are both ','"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"delimiter": ", "}, "delimiter is ', '; give one character"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"hold": "cubic"}, "hold is 'cubic'"),
        ("t,u,y\n0,1,2\n1,2,3\n", {"measured": "speed"}, "measured is 'speed'"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", {}, "record.csv is not text"),
    ],
)
def test_bad_text_is_an_error_of_one_line(write, content, extra, match):
    with pytest.raises(ValueError, match=match) as caught:
        read_record(write(content), **({"inputs": "u", "outputs": "y"} | extra))
    assert "\n" not in str(caught.value)


def test_paths_that_are_no_file(tmp_path, write):
    some = {"inputs": "u", "outputs": "y"}
    with pytest.raises(ValueError, match="nowhere.csv does not exist"):
        read_record(tmp_path / "nowhere.csv", **some)
    with pytest.raises(ValueError, match="is a folder"):
        read_record(str(tmp_path), **some)
    with pytest.raises(ValueError, match=r"unknown ending. Known are .csv"):
        read_record(write("t,u\n", "record.docx"), **some)
    with pytest.raises(ValueError, match=r"did you mean .hdf5\?"):
        read_record(write("t,u\n", "record.hdf"), **some)
    with pytest.raises(ValueError, match="path is of type int; give the path of a file, a data frame"):
        read_record(3, **some)


def test_a_long_file_is_quick(text, write):
    t, u, y = columns(25_000, 0.001)
    whole = text("t,u,y", t, u, y[:, 0])
    for body in (whole, whole.replace(f",{y[5, 0]!r}\n", ",\n")):
        path = write(body)
        start = time.perf_counter()
        [[float(cell or "nan") for cell in row] for row in csv.reader(body.splitlines()[1:])]
        plain = time.perf_counter() - start
        start = time.perf_counter()
        record = read_record(path, inputs="u", outputs="y")
        assert time.perf_counter() - start < 40 * plain
        assert record.samples == 25_000
