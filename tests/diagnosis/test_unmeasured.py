"""Laws where no sensor is: between a motor and a load that nothing measures, and at that load."""

import hidden
import independent
import numpy as np
import pytest
from found import generator
from hidden_laws import Effect

import jaxgray
from jaxgray.identification.identify_hidden import other_models
from jaxgray.mechanics.effects import Term, by_id, places_of
from jaxgray.numerics.progress import Silent
from jaxgray.report.documents.export import load, save

H, SAMPLES = 0.004, 3000
M = np.diag([2.0, 1.2])
LINE = np.array([[1.0, -1.0], [-1.0, 1.0]])
D, K = 0.5 * LINE + np.diag([1.2, 0.9]), 300.0 * LINE
STRUCTURE = "y1-h1, y1-ground:damper, h1-ground:damper"
SOUGHT = ("coulomb_friction", "cubic_stiffness", "dead_zone_stiffness", "quadratic_drag", "input_delay")


def records(law, draw=""):
    """A record for the fit and one for validation of the motor alone, under random steps of its torque."""
    rng = generator("unmeasured", draw)
    system = hidden.System(M, D, K, np.eye(2, 1))
    found = []
    for _ in range(2):
        u = np.repeat(rng.uniform(-20.0, 20.0, (SAMPLES // 25, 1)), 25, axis=0)
        if law is None:
            y = independent.simulate(M, D, K, u, H, E=np.eye(2, 1))[:, :1]
        else:
            y = hidden.simulate(system, u, H, (law,))[:, :1]
        found.append(jaxgray.Record(u, y + 1e-3 * rng.standard_normal(y.shape), H))
    return found


@pytest.mark.slow
def test_a_law_is_found_where_it_turns_the_load_of_the_linear_model_into_a_wall():
    law = Effect("coulomb_friction", "y2", {"Fc": 2.2})
    estimation, validation = records(law, "14")
    found = jaxgray.diagnose(estimation, validation=validation, hidden=1, structure=STRUCTURE, only=SOUGHT)
    # Nearest to the record is a linear model that has nothing to do with the drive.
    assert found.baseline.model.mass[1, 1] > 100.0
    others = other_models([estimation], {"hidden": 1, "structure": STRUCTURE}, Silent())
    assert np.allclose(np.diag(others[0].mass), np.diag(M), rtol=0.2)
    assert [(f.effect, f.location, f.status) for f in found.findings] == [("coulomb_friction", "h1", "named")]
    assert np.allclose(np.diag(found.extended.model.mass), np.diag(M), rtol=0.05)
    assert found.extended.model.hidden == ("h1",)
    assert abs(found.findings[0].parameters["Fc"].value - 2.2) < 4 * found.findings[0].parameters["Fc"].standard_error


def test_nothing_is_found_at_a_load_that_lacks_nothing():
    estimation, validation = records(None)
    found = jaxgray.diagnose(estimation, validation=validation, hidden=1, structure=STRUCTURE)
    assert found.verdict == "noise" and not found.findings


def test_the_canonical_form_has_no_places_for_laws():
    estimation, validation = records(None)
    found = jaxgray.diagnose(estimation, validation=validation, hidden=1)
    assert any("canonical form, which are no places" in text for text in found.warnings)
    assert not any("h1" in one.location for one in found.not_found)


def test_a_model_with_a_law_at_a_hidden_coordinate_is_saved_and_simulated(tmp_path):
    law = by_id("cubic_stiffness")
    place = next(one for one in places_of(law, ("u1",), ("y1",), ("h1",)) if one.name == "y1-h1")
    effects = (Term(law, place, np.array([3e4])),)
    model = jaxgray.MechanicalModel(M, D, K, hidden=1, effects=effects)
    save(model, tmp_path / "model.json")
    again = load(tmp_path / "model.json")
    assert again.effects[0].place.name == "y1-h1"
    u = np.repeat(generator("unmeasured").uniform(-20.0, 20.0, (40, 1)), 25, axis=0)
    expected = hidden.simulate(
        hidden.System(M, D, K, np.eye(2, 1)), u, H, (Effect("cubic_stiffness", "y1-y2", {"k3": 3e4}),)
    )
    assert np.allclose(again.simulate(u, H, substeps=4), expected[:, :1], atol=1e-4 * np.std(expected[:, 0]))


@pytest.mark.parametrize("given", ["model", "simulated"])
def test_hidden_coordinates_do_not_go_with_what_is_not_fitted(given):
    estimation, _ = records(None)
    judged = {"model": jaxgray.MechanicalModel([[1.0]], [[1.0]], [[1.0]]), "simulated": estimation.y}[given]
    with pytest.raises(ValueError, match="hidden is about a model that is fitted"):
        jaxgray.diagnose(estimation, hidden=1, **{given: judged})
