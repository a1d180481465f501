"""A simulation of which only a column of outputs is known: what the machine does otherwise."""

import json
import re
from types import SimpleNamespace

import hidden_laws
import numpy as np
import pytest
from hidden_draws import noise
from hidden_simulation import System, simulate

import jaxgray
from jaxgray.diagnosis import simulated_outputs
from jaxgray.diagnosis.findings import ModelSummary
from jaxgray.numerics.outcomes import ComputationError
from jaxgray.report.documents.diagnosis import diagnosis_document

H, SAMPLES = 0.01, 4000
FEW = ("coulomb_friction", "cubic_stiffness", "input_delay", "quadratic_drag")
SYSTEM = System(np.array([[1.2]]), np.array([[1.5]]), np.array([[60.0]]))


def moved(system, u, laws):
    return simulate(system, u, H, [hidden_laws.Effect(*law) for law in laws])


@pytest.fixture(scope="module")
def machine():
    """Inputs; what a simulation with dry friction makes of them; what a machine with more of it and a cubic spring
    does."""
    rng = np.random.default_rng(41)
    u = 12.0 * noise(rng, SAMPLES)[:, None]
    rubbing = ("coulomb_friction", "y1", {"Fc": 2.0})
    simulated = moved(SYSTEM, u, [rubbing])
    spring = ("cubic_stiffness", "y1", {"k3": 900.0})
    y = moved(SYSTEM, u, [("coulomb_friction", "y1", {"Fc": 2.6}), spring])
    y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    return jaxgray.Record(u, y, H, input_units=["N"], output_units=["m"]), simulated


@pytest.mark.slow
def test_what_the_machine_does_otherwise_is_named_with_both_numbers(machine):
    record, simulated = machine
    found = jaxgray.diagnose(record, simulated=simulated, only=FEW)
    named = {(f.effect, f.location): f for f in found.findings if f.stage == "model"}
    assert set(named) == {("parameter_error", "Fc of coulomb_friction at y1"), ("cubic_stiffness", "y1")}
    value = named["parameter_error", "Fc of coulomb_friction at y1"].parameters["value"]
    assert abs(value.value - 2.6) < 3 * value.standard_error < 0.2
    k3 = named["cubic_stiffness", "y1"].parameters["k3"]
    assert abs(k3.value - 900.0) < 3 * k3.standard_error < 90.0
    assert found.sentence.startswith("Your simulation misses ")
    assert re.search(r"Fc of Coulomb friction at y1 is (2\.6|2\.59)\S* ± \S+ N, not (2|1\.99)", found.sentence)
    assert "It moves as M, D, K with Coulomb friction at y1, Fc = 2.00" in found.sentence
    (law,) = found.simulated.findings
    assert (law.effect, law.location) == ("coulomb_friction", "y1")
    document = json.loads(json.dumps(diagnosis_document(found)))
    assert document["simulated"]["findings"][0]["effect"] == "coulomb_friction"
    assert document["simulated"]["left_percent"]["y1"] < 0.5
    assert document["own_model"] and found.gain.held_out and found.excess < 1.05


def test_simulated_outputs_are_numbers_for_every_sample(machine):
    record, simulated = machine
    shown = simulated_outputs.as_if_measured(record, simulated[:, 0], 0)
    added = shown.y - simulated
    assert abs(np.std(added) / (simulated_outputs.NOISE * simulated.std()) - 1) < 0.1 and shown.y.shape == (SAMPLES, 1)
    spoilt = simulated.copy()
    spoilt[7] = np.nan
    for bad, message in (
        (simulated[:-1], r"shape \(3999, 1\), the measured outputs have \(4000, 1\)"),
        (spoilt, r"simulated\[7, 0\] is nan"),
        (np.ones_like(simulated), "simulated y1 does not move"),
    ):
        with pytest.raises(ValueError, match=message):
            jaxgray.diagnose(record, simulated=bad)
    own = jaxgray.MechanicalModel([[1.0]], [[1.0]], [[1.0]])
    with pytest.raises(ValueError, match="simulated and model are different things to judge"):
        jaxgray.diagnose(record, simulated=simulated, model=own)
    with pytest.raises(ValueError, match="give that record alone"):
        jaxgray.diagnose([record, record], simulated=simulated)


def test_a_model_that_leaves_more_than_half_a_percent_is_not_the_simulation(machine):
    record, simulated = machine
    shown = simulated_outputs.as_if_measured(record, simulated, 0)
    model = jaxgray.MechanicalModel([[1.2]], [[1.5]], [[60.0]])
    size = float(np.std(shown.y))

    def found(left):
        error = {"y1": float(np.hypot(left, simulated_outputs.NOISE) * size)}
        summary = ModelSummary(model, None, {}, {"estimation": error, "validation": None})
        return SimpleNamespace(
            baseline=summary, extended=None, findings=(), records=(shown,), validation_records=(shown,)
        )

    made, stands_in = simulated_outputs.stand_in(found(0.004))
    assert made is model and stands_in.findings == () and abs(stands_in.left_percent["y1"] - 0.4) < 1e-6
    with pytest.raises(ComputationError, match="leave 2 % of the motion of y1"):
        simulated_outputs.stand_in(found(0.02))
