"""The examples run as they stand, and reach the figures that they claim."""

import numpy as np
import pytest
from shown import ROOT, example

BENCH = ROOT.parent / "shared" / "data" / "motor_bench_estimation.csv"


@pytest.mark.slow
def test_the_papers_simulation_beats_its_published_errors(tmp_path, capsys):
    paper = example("paper_simulation")
    found = paper.main(["--samples", "4000", "--out", str(tmp_path)])
    errors = found["errors"]
    assert errors["published"] == paper.PUBLISHED
    assert np.all(np.less(errors["refined"], paper.PUBLISHED)), errors["refined"]
    assert np.all(np.less(errors["exact map, automatic τ and i"], paper.PUBLISHED))
    fixed = np.array(errors["paper's map, τ = 0.15 s, i = 10"])
    assert np.all(np.array(errors["exact map, automatic τ and i"]) < 0.1 * fixed)
    assert np.all(found["nrmse"]["refined", "noise-free"] < 0.005)
    assert np.all(found["nrmse"]["refined", "noisy"] < 0.04)
    assert len(found["zeros"]["all"].values) == 0
    # Antiresonances of a collocated pair: the other coordinate alone on its spring.
    alone = np.sqrt(paper.STIFFNESS[1, 1] / paper.MASS[1, 1]) / (2 * np.pi)
    assert found["zeros"]["u1", "y1"].antiresonance_hz == pytest.approx([alone], rel=2e-3)
    for table in found["sweeps"].values():
        assert np.nanmax(np.min(table.validation_fit_percent, axis=2)) > 96
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bode.png", "compare.png", "sweep.png"]
    assert "published" in capsys.readouterr().out


def test_the_micro_manipulators_frequencies_are_found_without_tuning(capsys):
    manipulator = example("micro_manipulator")
    found = manipulator.main(["--samples", "4000"])
    error = found["frequencies_hz"] - manipulator.FREQUENCIES_HZ
    assert np.all(np.abs(error) < 1e-3 * manipulator.FREQUENCIES_HZ)
    assert np.all(np.abs(error) < 4.5 * found["standard_errors_hz"])
    assert np.all(np.array(found["errors"]) < 0.005)
    assert found["damping_ratios"] == pytest.approx(manipulator.DAMPING_RATIO, rel=0.01)
    assert "83.107" in capsys.readouterr().out


@pytest.mark.slow
def test_the_simulated_bench_agrees_with_its_frequency_response_and_the_truth(capsys):
    bench = example("measured_record")
    rows = bench.main(["--samples", "7500"])["rows"]
    assert [row[0] for row in rows] == ["resonance", "antiresonance"]
    k, (motor, load) = bench.STIFFNESS[0, 0], np.diag(bench.INERTIA)
    truth = np.sqrt([k * (1 / motor + 1 / load), k / load]) / (2 * np.pi)
    for (what, _, model, error, without), true in zip(rows, truth):
        assert model == pytest.approx(true, rel=1e-3), what
        assert abs(model - true) < 4.5 * error, what
        assert without == pytest.approx(true, abs=0.5), what
    assert "current to motor_angle" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.skipif(not BENCH.exists(), reason=f"measured data are not part of the project: no {BENCH.name}")
def test_a_measured_bench_agrees_with_its_frequency_response(capsys):
    rows = example("measured_record").main([str(BENCH)])["rows"]
    (resonance, antiresonance) = rows
    assert (resonance[0], antiresonance[0]) == ("resonance", "antiresonance")
    assert 76 < resonance[4] < 77 and 53 < antiresonance[4] < 55
    assert abs(resonance[2] - resonance[4]) < 1.0
    assert abs(antiresonance[2] - antiresonance[4]) < 1.0


@pytest.mark.slow
def test_an_effect_of_ones_own_is_found(capsys):
    own = example("own_effect")
    found = own.main(["--samples", "2000"])
    (finding,) = [f for f in found.findings if f.stage == "model"]
    assert finding.effect == "quintic_stiffness" and finding.status == "named", str(found)
    estimate = finding.parameters["k5"]
    assert abs(estimate.value - own.QUINTIC) < 4.5 * estimate.standard_error < 0.1 * own.QUINTIC
    assert finding.gain.ci95[0] > 0
    assert "With the law" in capsys.readouterr().out
