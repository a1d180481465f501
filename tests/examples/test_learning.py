"""The examples of learning run as they stand, and reach the figures that they claim."""

import numpy as np
import pytest
from shown import example


@pytest.mark.slow
def test_a_network_learns_the_force_and_leaves_the_matrices_right(capsys):
    found = example("learned_force").main(["--samples", "1000"])
    deviation = np.abs(found["joint"] - found["truth"]) / found["standard_errors"]
    assert np.all(deviation < 4.5), deviation
    # The linear model is sure of what is wrong.
    assert np.max(np.abs(found["linear"] - found["truth"]) / found["standard_errors"]) > 10
    assert found["with_network"] < 1.2 * found["noise"] < 0.3 * found["physics_alone"]
    assert "with the network" in capsys.readouterr().out


@pytest.mark.slow
def test_weights_learned_by_gradient_beat_the_default_on_unseen_records(capsys):
    found = example("learned_weights").main(["--unseen", "2", "--steps", "25"])
    weights = np.exp(found["theta"][1:])
    # The phase in which the sensors are shaken, and one in which they are not.
    assert weights[4] < 0.2 * np.median(weights[7:])
    assert np.median(found["learned"]) < 0.7 * np.median(found["default"])
    assert "unseen" in capsys.readouterr().out


@pytest.mark.slow
def test_a_designed_excitation_shrinks_the_error_bar_as_predicted(capsys):
    design = example("designed_excitation")
    found = design.main(["--realisations", "60", "--steps", "15"])
    plain, better = ({k: found[name][k][design.CHOSEN] for k in ("predicted", "found")} for name in found)
    assert plain["found"] > 2 * better["found"]
    # Sixty realisations know a variance to 18 %.
    for part in (plain, better):
        assert part["predicted"] == pytest.approx(part["found"], rel=0.6)
    for part in found.values():
        np.testing.assert_allclose(np.mean(part["u"] ** 2, axis=0), 1.0, rtol=1e-3)
    assert "times smaller" in capsys.readouterr().out
