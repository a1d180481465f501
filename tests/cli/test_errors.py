"""Every error is one line on stderr and one of two exit codes, and leaves no file behind."""

import sys

import pytest

from jaxgray.cli import main

CHANNELS = ["--inputs", "u1,u2", "--outputs", "y1,y2"]


def fails(capsys, argv, code, *texts):
    """The command ends with this code and says these texts in one line, on stderr alone."""
    assert main([str(one) for one in argv]) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.endswith("\n") and said.err.count("\n") == 1, said.err
    assert said.err.startswith("error: ")
    for text in texts:
        assert text in said.err, said.err


def spoilt(rows, row, column, value):
    """The rows with one cell replaced."""
    rows = [list(cells) for cells in rows]
    rows[row][column] = value
    return rows


@pytest.mark.parametrize(
    "spoil, texts",
    [
        (lambda rows: spoilt(rows, 20, 3, "broken"), ("y1", "broken")),
        (lambda rows: spoilt(rows, 20, 3, "inf"), ("infinite",)),
        (lambda rows: spoilt(rows, 20, 3, "1e300"), ("1e+300", "rescale")),
        (lambda rows: spoilt(rows, 20, 1, ""), ("u1", "missing")),
        (lambda rows: spoilt(rows, 20, 0, rows[19][0]), ("does not increase",)),
        (
            lambda rows: [[repr(0.005 * (k + 1e6 * (k > 20))), *row[1:]] for k, row in enumerate(rows)],
            ("gaps too long",),
        ),
        (lambda rows: rows[:1], ("at least 2",)),
        (lambda rows: rows[:0], ("small.csv",)),
    ],
    ids=["text", "infinite", "huge", "gap in input", "time twice", "gaps in time", "one row", "no row"],
)
def test_bad_data(capsys, small, spoil, texts):
    rows, write = small
    fails(capsys, ["identify", write(spoil(rows)), *CHANNELS], 2, *texts)


@pytest.mark.parametrize(
    "options, texts",
    [
        (["--inputs", "u1,u22", "--outputs", "y1,y2"], ("u22", "u2")),
        (["--inputs", "u1,u2"], ("--outputs",)),
        (["--inputs", ",", "--outputs", "y1,y2"], ("--inputs",)),
        ([*CHANNELS, "--weight", "moes"], ("moes", "moesp")),
        ([*CHANNELS, "--map", "best"], ("best", "exact")),
        ([*CHANNELS, "--holdout", "1.5"], ("1.5", "between 0 and 1")),
        ([*CHANNELS, "--holdout", "0"], ("--holdout",)),
        ([*CHANNELS, "--holdout", "0.3", "--validation", "x.csv"], ("--validation", "--holdout")),
        ([*CHANNELS, "--holdout", "much"], ("--holdout", "valid")),
        ([*CHANNELS, "--validation", "nowhere.csv"], ("nowhere.csv",)),
        ([*CHANNELS, "--fix", "stiffness=3"], ("stiffness=3",)),
        ([*CHANNELS, "--fix", "mass[0,5]=1"], ("mass[0,5]",)),
        ([*CHANNELS, "--structure", "diagonal"], ("diagonal-mass",)),
        ([*CHANNELS, "--noise", "loud"], ("loud", "innovations")),
        ([*CHANNELS, "--hold", "first"], ("first", "linear")),
        ([*CHANNELS, "--measured", "speed"], ("speed", "velocity")),
        ([*CHANNELS, "--excitation", "wind"], ("wind", "force")),
        ([*CHANNELS, "--input-map", "u1:y1"], ("u2",)),
        ([*CHANNELS, "--time-constant", "0.1,slow"], ("--time-constant", "slow")),
        ([*CHANNELS, "--block-rows", "2"], ("block_rows",)),
        ([*CHANNELS, "--json", "no/such/folder/out.json"], ("no/such/folder",)),
        ([*CHANNELS, "--frobnicate"], ("--frobnicate",)),
        ([*CHANNELS, "--time", "clock"], ("clock",)),
    ],
)
def test_bad_arguments(capsys, small, options, texts):
    fails(capsys, ["identify", small[1](), *options], 2, *texts)


def test_bad_files(capsys, tmp_path):
    fails(capsys, ["identify", tmp_path / "none.csv", *CHANNELS], 2, "none.csv", "does not exist")
    (tmp_path / "empty.csv").write_text("")
    fails(capsys, ["identify", tmp_path / "empty.csv", *CHANNELS], 2, "empty")
    fails(capsys, ["identify", tmp_path, *CHANNELS], 2, "folder")
    (tmp_path / "model.json").write_text('{"mass": [[1]]}')
    fails(capsys, ["simulate", tmp_path / "model.json", tmp_path / "none.csv"], 2, "stiffness")
    fails(capsys, ["simulate", tmp_path / "no.json", tmp_path / "none.csv"], 2, "no.json")
    fails(capsys, ["identify"], 2, "FILE")
    fails(capsys, ["idendify"], 2, "idendify")
    fails(capsys, ["demo", "--seed", "-1"], 2, "seed")


@pytest.mark.parametrize("command", ["identify", "sweep"])
def test_constant_input_is_a_failed_computation(capsys, small, tmp_path, command):
    rows, write = small
    rows = [[row[0], "1.0", *row[2:]] for row in rows]
    target = tmp_path / "out.json"
    fails(capsys, [command, write(rows), *CHANNELS, "--json", target], 3, "u1", "constant")
    assert not target.exists()


def test_too_short_is_a_failed_computation(capsys, small):
    rows, write = small
    fails(capsys, ["identify", write(rows[200:310]), *CHANNELS, "--block-rows", "12"], 3, "12 block rows")


def test_anything_unexpected_is_one_line_and_a_trace_on_request(capsys, small, monkeypatch):
    from jaxgray.cli import files

    def broken(*_):
        raise KeyError("first line\nsecond line")

    monkeypatch.setattr(files, "read_pair", broken)
    fails(capsys, ["identify", small[1](), *CHANNELS], 3, "KeyError", "--verbose")
    assert main(["identify", str(small[1]()), *CHANNELS, "--verbose"]) == 3
    assert "Traceback" in capsys.readouterr().err


def test_numpy_failures_are_computations(capsys):
    import numpy as np

    from jaxgray.cli import explain

    assert explain(np.linalg.LinAlgError("singular"))[0] == 3
    assert explain(MemoryError())[0] == 3
    assert explain(PermissionError(13, "Permission denied", "out.json"))[0] == 2


def test_help_and_version_need_no_jax(capsys):
    import subprocess

    code = (
        "import sys\nfrom jaxgray.cli import main\nassert main(['identify', '--help']) == 0\n"
        "assert main([]) == 0\nsys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True).returncode == 0
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip()
