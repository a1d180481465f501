"""The commands from file to file, and the figures, on one record of the reference system.

All in one file: the workers of a test run share files out, and each would compile for itself.
"""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import scipy.linalg
from documents import WRITTEN
from independent import REFERENCE, REFERENCE_TIME, reference_record, relative_errors

import jaxgray
from jaxgray.cli import main
from jaxgray.mechanics.runs.simulate import initial_state
from jaxgray.numerics.programs.backend import flags_are_known
from jaxgray.report.documents.terms import term_of
from jaxgray.report.figures.identification import MOST_POINTS, bode, compare, residuals, sweep_map

CHANNELS = ["--inputs", "u1,u2", "--outputs", "y1,y2"]


def strict(text):
    """JSON without NaN and infinity, which Python would read."""

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def run(*argv):
    assert main([str(one) for one in argv]) == 0


@pytest.fixture(scope="module")
def identified(records, tmp_path_factory):
    """What `identify` wrote: JSON and figures."""
    folder = tmp_path_factory.mktemp("identified")
    options = ["--validation", records[1], "--json", folder / "result.json", "--figures", folder / "drawn"]
    options += ["--report", folder / "report.html"]
    run("identify", records[0], *CHANNELS, *options, "--quiet")
    return folder


def test_identify_writes_strict_json(identified):
    found = strict((identified / "result.json").read_text())
    assert found["schema"] == "jaxgray/identification/1"
    model = found["model"]
    errors = relative_errors([model[name] for name in ("mass", "damping", "stiffness")], REFERENCE.values())
    assert np.all(errors < [2e-3, 6e-3, 2e-3])
    for name, true in zip(("mass", "damping", "stiffness"), REFERENCE.values()):
        assert np.all(np.abs(model[name] - true) < 5 * np.array(model["standard_errors"][name]))
    assert model["units"]["mass"][0][1] == "N s^2/m"
    assert model["input_map"] == [[1.0, 0.0], [0.0, 1.0]]
    for kind in ("estimation", "validation"):
        assert set(found["fit_percent"][kind]) == set(found["rmse"][kind]) == {"y1", "y2"}
        assert min(found["fit_percent"][kind].values()) > 95
    assert found["noise_floor"]["y1"] == pytest.approx(3e-4, rel=0.05)
    poles = np.linalg.eigvals(
        np.block(
            [
                [np.zeros((2, 2)), np.eye(2)],
                [-np.linalg.solve(REFERENCE["M"], REFERENCE[name]) for name in "KD"],
            ]
        )
    )
    frequencies = np.sort(np.abs(poles[poles.imag > 0])) / (2 * np.pi)
    for mode, frequency in zip(found["modes"], frequencies):
        assert 0 < mode["frequency_standard_error"] < 1e-3
        assert mode["frequency_hz"] == pytest.approx(frequency, rel=2e-2)
    assert found["zeros_hz"]["u1->y1"] == pytest.approx([np.sqrt(100) / (2 * np.pi)], rel=1e-2)
    assert np.shape(found["covariance"]["matrix"]) == (9, 9) == (len(found["covariance"]["names"]), 9)
    assert found["residual_test"] == {"white": True, "input_explained": False, "feedback": False}
    assert found["structure_test"]["fits"]
    assert found["records"]["estimation"][0]["samples"] == 2000


@pytest.mark.slow
def test_a_later_process_runs_the_programs_of_the_first(records, tmp_path):
    code = "import sys; from jaxgray.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "identify", str(records[0]), *CHANNELS, "--quiet", "--json"]
    here = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "JAXGRAY_PROGRAMS": "1"}
    here.pop("JAX_COMPILATION_CACHE_DIR")

    def identified_by_another(name):
        subprocess.run([*command, str(tmp_path / name)], check=True, env=here, stderr=subprocess.DEVNULL)
        WRITTEN.check_folder(tmp_path)
        programs = [path.stat() for path in tmp_path.glob("jaxgray/xla/*/jaxgray-programs/*")]
        return strict((tmp_path / name).read_text()), {(one.st_ino, one.st_mtime_ns) for one in programs}

    first, programs = identified_by_another("first.json")
    again, later = identified_by_another("again.json")
    assert again["model"] == first["model"] and again["fit_percent"] == first["fit_percent"]
    if flags_are_known():
        assert programs and later == programs


def test_without_refinement_what_is_not_known_is_null(records, capsys):
    run("identify", records[0], *CHANNELS, "--no-refine", "--json", "-")
    said = capsys.readouterr()
    found = strict(said.out)
    assert said.err == ""
    assert found["model"]["standard_errors"] is None
    for name in ("covariance", "condition_number", "at_edge", "weak_directions", "unmoved", "structure_test"):
        assert found[name] is None
    assert found["modes"][0]["frequency_standard_error"] is None
    assert "validation" not in found["fit_percent"]


def test_the_terminal_says_the_verdict_first(records, capsys):
    run("identify", records[0], *CHANNELS, "--validation", records[1])
    said = capsys.readouterr()
    assert said.err == ""
    lines = said.out.splitlines()
    assert lines[0].startswith("2 coordinates, 2 inputs: fit 9")
    assert lines[0].endswith("% on data the fit has not seen; residual white.")
    for text in ("mass [N s^2/m]", "stiffness [N/m]", " ± ", "validation fit", "noise floor", "feedback"):
        assert text in said.out
    assert "\x1b" not in said.out


def test_quiet_says_nothing(records, capsys, tmp_path):
    run("identify", records[0], *CHANNELS, "--quiet", "--no-refine", "--json", tmp_path / "out.json")
    said = capsys.readouterr()
    assert said.out == said.err == ""


def test_warnings_of_the_reader_are_told_and_kept(records, tmp_path, capsys):
    lines = records[0].read_text().splitlines()
    del lines[1000:1003]
    path = tmp_path / "gap.csv"
    path.write_text("\n".join(lines) + "\n")
    run("identify", path, *CHANNELS, "--no-refine", "--json", tmp_path / "out.json")
    said = capsys.readouterr()
    told = [line for line in said.err.splitlines() if line.startswith("warning: gap.csv: 3 of 2000")]
    assert len(told) == 1
    assert any(
        text.startswith("gap.csv: 3 of 2000") for text in strict((tmp_path / "out.json").read_text())["warnings"]
    )


def test_simulate_takes_the_result_and_repeats_its_fit(identified, records, tmp_path, capsys):
    out = tmp_path / "run.csv"
    run("simulate", identified / "result.json", records[1], "--out", out, "--json", "-")
    said = strict(capsys.readouterr().out)
    before = strict((identified / "result.json").read_text())["fit_percent"]["validation"]
    assert said["fit_percent"] == pytest.approx(before, abs=1e-4)
    table = jaxgray.read_record(out, inputs="y1 measured", outputs=["y1 simulated", "y1 residual"])
    assert table.output_units == ("m", "m")
    np.testing.assert_allclose(table.u[:, 0] - table.y[:, 0], table.y[:, 1], atol=1e-15)


def test_simulate_begins_where_the_whole_model_does(tmp_path, capsys):
    """A friction that sticks for long: from the first state of the linear part alone, the run starts elsewhere."""
    M, D, K = (np.array([[float(x)]]) for x in (1.0, 0.5, 100.0))
    friction = term_of(
        {"effect": "coulomb_friction", "location": "y1", "parameters": {"Fc": 2.0, "eps": 0.02}}, ["u1"], ["y1"]
    )
    model = jaxgray.MechanicalModel(M, D, K, effects=(friction,))
    u = np.repeat(np.random.default_rng(1).uniform(-3, 3, 20), 20)
    y = model.simulate(u, 0.01, x0=[0.2, 1.0], substeps=32)
    path = tmp_path / "start.csv"
    rows = zip(0.01 * np.arange(len(u)), u, y[:, 0])
    path.write_text("\n".join(["t,u1,y1", *(",".join(map(repr, map(float, row))) for row in rows)]) + "\n")
    jaxgray.save(model, tmp_path / "model.json")
    run("simulate", tmp_path / "model.json", path, "--json", "-")
    assert strict(capsys.readouterr().out)["fit_percent"]["y1"] > 99.9
    linear = dataclasses.replace(model, effects=())
    x0, _ = initial_state(linear, u, y, 0.01)
    assert np.max(np.abs(model.simulate(u, 0.01, x0=x0) - y)) > 0.05 * np.max(np.abs(y))


def test_text_as_the_options_say(records, tmp_path, capsys):
    """Units, delimiter and decimal comma by option."""
    text = records[0].read_text().replace(",", "\t").replace(".", ",").replace(" [N]", "").replace(" [m]", "")
    path = tmp_path / "comma.txt"
    path.write_text(text)
    options = ["--delimiter", "tab", "--decimal", ",", "--input-units", "kN,kN", "--output-units", "mm,mm"]
    run("identify", path, *CHANNELS, *options, "--no-refine", "--json", "-")
    found = strict(capsys.readouterr().out)["model"]
    run("identify", records[0], *CHANNELS, "--no-refine", "--json", "-")
    assert found["stiffness"] == strict(capsys.readouterr().out)["model"]["stiffness"]
    assert found["units"]["stiffness"][0][0] == "kN/mm"
    assert main(["identify", str(path), *CHANNELS, "--input-units", "N"]) == 2
    assert "input_units" in capsys.readouterr().err


def test_simulate_refuses_other_channels(identified, records, capsys):
    assert main(["simulate", str(identified / "result.json"), str(records[1]), "--inputs", "u1"]) == 2
    assert "2 inputs" in capsys.readouterr().err


def test_figures_are_files(identified):
    for name in ("compare", "residuals", "bode", "mode_shapes"):
        assert (identified / "drawn" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_holds_what_the_json_holds(identified):
    text = (identified / "report.html").read_text()
    carried = text.partition('<script type="application/json" id="document">')[2].partition("</script>")[0]
    assert strict(carried) == strict((identified / "result.json").read_text())


def test_a_page_without_a_folder_is_refused_before_anything_is_computed(records, tmp_path, capsys):
    assert main(["identify", str(records[0]), *CHANNELS, "--report", str(tmp_path / "no" / "out.html")]) == 2
    assert "the folder" in capsys.readouterr().err


def test_sweep_tabulates_every_choice(records, tmp_path, capsys):
    target = tmp_path / "sweep.json"
    options = ["--time-constant", "0.03,0.1", "--block-rows", "6,8", "--validation", records[1]]
    run("sweep", records[0], *CHANNELS, *options, "--json", target, "--figures", tmp_path)
    found = strict(target.read_text())
    assert found["schema"] == "jaxgray/sweep/1"
    assert np.shape(found["cells"]) == (2, 2)
    assert found["unstable"] == found["failed"] == 0
    best = found["best"]
    assert best["time_constant"] in (0.03, 0.1) and best["block_rows"] in (6, 8)
    assert min(best["fit_percent"]["validation"].values()) > 95
    assert np.all(relative_errors([best["mass"]], [REFERENCE["M"]]) < 0.02)
    assert capsys.readouterr().out.startswith("Best of 4: time constant")
    assert (tmp_path / "sweep_map.png").exists()


def record(seed):
    """A record with the data of the files."""
    u, y, _ = reference_record(seed, samples=2000)
    return jaxgray.Record(u, y, REFERENCE_TIME, input_units=("N", "N"), output_units=("m", "m"))


@pytest.fixture(scope="module")
def result():
    return jaxgray.identify(record(11), validation=record(12))


def test_compare(result):
    figure = compare(result)
    figure.canvas.draw()
    assert "held-out" in figure.get_suptitle()
    first = figure.axes[0]
    assert first.get_ylabel() == "y1 [m]" and first.get_title(loc="left").startswith("y1: fit 9")
    measured, simulated = first.get_lines()
    np.testing.assert_array_equal(measured.get_ydata(), result.validation_records[0].y[:, 0])
    np.testing.assert_array_equal(simulated.get_ydata(), result.validation[0].simulated[:, 0])
    assert figure.axes[-1].get_xlabel() == "time [s]"
    assert "record of the fit" in compare(result, held_out=False).get_suptitle()
    with pytest.raises(ValueError, match="record=3 is not there; there are 1"):
        compare(result, record=3)


def test_long_records_keep_their_extremes_and_gaps(result):
    data = result.validation_records[0]
    u, y = (np.tile(x, (15, 1)) for x in (data.u, data.y))
    y[20000, 0], y[100:2000, 1] = 7.0, np.nan
    fit = result.validation[0]
    stretched = dataclasses.replace(
        fit, simulated=np.tile(fit.simulated, (15, 1)), residual=np.tile(fit.residual, (15, 1))
    )
    long = jaxgray.Record(u, y, REFERENCE_TIME)
    figure = compare(dataclasses.replace(result, validation=(stretched,), validation_records=(long,)))
    figure.canvas.draw()
    for axes in figure.axes:
        for line in axes.get_lines():
            assert len(line.get_ydata()) <= MOST_POINTS
    assert np.max(figure.axes[0].get_lines()[0].get_ydata()) == 7.0
    gap = next(axes for axes in figure.axes if axes.get_ylabel() == "y2")
    assert np.isnan(gap.get_lines()[0].get_ydata()).any()


def test_residuals(result):
    figure = residuals(result)
    figure.canvas.draw()
    assert figure.get_suptitle().endswith("white; inputs explain no more of it")
    assert [axes.get_title() for axes in figure.axes[:3]] == [
        "autocorrelation",
        "with earlier u1",
        "with earlier u2",
    ]
    assert figure.axes[-1].get_xlabel() == "lag [samples]"


def test_bode(result):
    figure = bode(result)
    figure.canvas.draw()
    above, below = figure.axes[0], figure.axes[2]
    assert above.get_ylabel() == "|H|, receptance [m/N]" and below.get_ylabel() == "phase [°]"
    curve = above.get_lines()[0]
    frequency, size = curve.get_data()
    direct = result.model.frequency_response(2 * np.pi * np.asarray(frequency))[:, 0, 0]
    np.testing.assert_allclose(size, np.abs(direct), rtol=1e-9)
    marked = [line.get_xdata()[0] for line in above.get_lines()[1:]]
    np.testing.assert_allclose(marked[:2], result.model.modes().natural_frequency_hz)
    assert marked[2] == pytest.approx(result.model.zeros(input="u1", output="y1").antiresonance_hz[0])
    assert len(above.collections) == 1


def test_bode_without_refinement_has_no_band(result):
    figure = bode(dataclasses.replace(result, uncertainty=None))
    figure.canvas.draw()
    assert "band" not in figure.get_suptitle()
    assert not figure.axes[0].collections


def test_sweep_map():
    rng = np.random.default_rng(1)
    fit = rng.uniform(80, 97, (3, 2, 2))
    fit[1, 1] = np.nan
    fit[2, 0] = 98.0
    matrices = [np.zeros((3, 2, 2, 2))] * 3
    found = jaxgray.Sweep(np.array([0.01, 0.03, 0.1]), np.array([4, 6]), fit, None, *matrices, 1, 0, ("y1", "y2"))
    assert found.best_index == (2, 0) and found.best["time_constant"] == 0.1
    assert "98.00*" in repr(found) and "1 of 6 choices unstable" in repr(found) and "–" in repr(found)
    figure = sweep_map(found)
    figure.canvas.draw()
    assert figure.axes[0].get_ylabel() == "time constant [s]"
    assert [text.get_text() for text in figure.axes[0].texts].count("–") == 1


def test_rows_of_two_files_at_their_own_times(capsys, tmp_path):
    rng = np.random.default_rng(5)
    force = np.arange(0.0, 30.0, 0.01)
    u = np.repeat(rng.choice([-1.0, 1.0], len(force) // 25), 25)
    seen = np.sort(rng.uniform(0.0, 29.9, 2500))
    every = np.union1d(force, seen)
    held = u[np.searchsorted(force, every, side="right") - 1]
    # m = 2, d = 1, k = 200: exact from event to event.
    A, state, y = np.array([[0.0, 1.0], [-100.0, -0.5]]), np.zeros(2), []
    for k, step in enumerate(np.diff(every, append=every[-1])):
        y.append(state[0])
        rest = np.array([held[k] / 200.0, 0.0])
        state = rest + scipy.linalg.expm(A * step) @ (state - rest)
    y = np.array(y)[np.searchsorted(every, seen)] + 1e-5 * rng.standard_normal(len(seen))
    first, second, out = tmp_path / "angle.csv", tmp_path / "force.csv", tmp_path / "out.json"
    first.write_text("t,q [m]\n" + "\n".join(f"{a!r},{b!r}" for a, b in zip(seen.tolist(), y.tolist())))
    second.write_text("t,F [N]\n" + "\n".join(f"{a!r},{b!r}" for a, b in zip(force.tolist(), u.tolist())))
    options = ["--also", f"{second}:F", "--inputs", "F", "--outputs", "q", "--json", str(out)]
    assert main(["identify", str(first), *options]) == 0
    document = json.loads(out.read_text())
    found = [document["model"][name][0][0] for name in ("mass", "damping", "stiffness")]
    np.testing.assert_allclose(found, (2.0, 1.0, 200.0), rtol=2e-3)
    assert any("The clock of q is set" in text for text in document["warnings"])
    assert "times of their own" in capsys.readouterr().out
