"""Laws refitted beside one another: what comes out is what comes out one after the other, and nothing is done twice."""

from found import diagnosed, hidden_case, model_findings

from jaxgray.diagnosis import bench
from jaxgray.numerics import side_by_side

FRICTION = ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "position_dependent_friction")


def test_a_second_core_changes_nothing_and_the_noise_of_a_fit_is_estimated_once(monkeypatch):
    case = hidden_case("coulomb_friction")
    found, estimate, residuals = [], bench.estimate_chain, []

    def kept(e, *rest):
        residuals.append(e)
        return estimate(e, *rest)

    monkeypatch.setattr(bench, "estimate_chain", kept)
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
