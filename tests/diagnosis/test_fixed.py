"""What was fixed in the identification stays fixed when laws are added."""

import hidden
import numpy as np
import pytest
from found import SAMPLES, generator, model_findings
from hidden_laws import Effect
from hidden_simulation import System

import jaxgray


@pytest.mark.slow
def test_the_scale_of_a_base_excitation_stays_where_it_was_set():
    rng = generator("base excitation")
    system = System(np.array([[1.0]]), np.array([[2.0]]), np.array([[400.0]]))
    ground = hidden.draws.excitation(rng, "noise", SAMPLES, np.array([15.0]))
    spring = Effect("cubic_stiffness", "y1", {"k3": 4e4})
    clean = hidden.simulate(system, -ground, 0.02, [spring])
    y = clean + 0.01 * clean.std() * rng.standard_normal(clean.shape)
    diagnosis = jaxgray.diagnose(
        jaxgray.Record(ground, y, 0.02), excitation="base-acceleration", relative=True, only=["cubic_stiffness"]
    )
    (found,) = model_findings(diagnosis)
    mass = next(shift for shift in diagnosis.shifts if shift.name == "mass[0,0]")
    assert abs(mass.after - 1.0) < 1e-12 and mass.standard_error == 0.0
    for name, true, value in (
        ("k3", 4e4, found.parameters["k3"]),
        ("stiffness[0,0]", 400.0, diagnosis.shifts[2]),
        ("damping[0,0]", 2.0, diagnosis.shifts[1]),
    ):
        reached = getattr(value, "after", None) or value.value
        assert abs(reached - true) < 4 * value.standard_error < 0.05 * true, (name, str(diagnosis))
