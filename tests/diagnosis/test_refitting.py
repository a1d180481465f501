"""Laws refitted beside one another: what comes out is what comes out one after the other, and nothing is done twice."""

from types import SimpleNamespace

import numpy as np
import pytest
from found import diagnosed, hidden_case, model_findings

from jaxgray.diagnosis.estimation import context as context
from jaxgray.diagnosis.estimation.gauss_newton import _Step
from jaxgray.identification.setup.structure import Structure
from jaxgray.numerics.programs import side_by_side

FRICTION = ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "position_dependent_friction")


@pytest.mark.slow
def test_a_second_core_changes_nothing_and_the_noise_of_a_fit_is_estimated_once(monkeypatch):
    case = hidden_case("coulomb_friction")
    found, estimate, residuals = [], context.estimate_noise_model, []

    def kept(e, *rest):
        residuals.append(e)
        return estimate(e, *rest)

    monkeypatch.setattr(context, "estimate_noise_model", kept)
    for cores in (1, 2):
        monkeypatch.setattr(side_by_side, "cores", lambda cores=cores: cores)
        residuals.clear()
        diagnosis = diagnosed(case, only=FRICTION)
        assert len(residuals) > 3 and len({id(e) for e in residuals}) == len(residuals)
        (one,) = model_findings(diagnosis)
        values = [(p.value, p.standard_error) for p in one.parameters.values()]
        refused = [(r.effect, r.location, r.delta_bic, r.why) for r in diagnosis.rejected]
        found.append((one.effect, one.location, one.delta_bic, values, refused))
    assert found[0][0] == "coulomb_friction" and len(found[0][4]) > 1
    assert found[0] == found[1]


def test_a_step_is_the_same_in_any_unit():
    # A cubic spring of 1e10 N/m³ beside a mass of 1 kg: its curvature is next to nothing, its step is not.
    setup = SimpleNamespace(dofs=1, sizes=(1, 1, 1), structure=Structure())
    layout = SimpleNamespace(entries=3, first=5, size=6, lower=np.array([-np.inf]), upper=np.array([np.inf]))
    rows = np.random.default_rng(5).standard_normal((6, 60))
    H, g = rows @ rows.T, np.array([0.3, -0.2, 0.4, 0.5, -0.1, 0.2])
    theta = np.ones(6)
    for unit in (1.0, 1e-6, 1e14):
        scale = np.array([1.0, 1.0, 1.0, 1.0, 1.0, unit])
        step = _Step(setup, layout, np.zeros(6, bool))(theta * scale, H / np.outer(scale, scale), g / scale, 0.0)
        np.testing.assert_allclose(step / scale, -np.linalg.solve(H, g), rtol=1e-6)
