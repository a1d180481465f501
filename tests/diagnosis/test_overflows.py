"""Trials of a refit that overflow are refused before they are used, without a warning, and the refit goes on."""

import numpy as np
import pytest
from found import diagnosed, hidden_case, model_findings

from jaxgray.diagnosis.estimation.normal_equations import Equations
from jaxgray.diagnosis.model.simulator import Simulator


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e308])
def test_refits_whose_trials_overflow_find_the_law_all_the_same(monkeypatch, value):
    call, run_and_jacobian, run = Equations.__call__, Simulator.run_and_jacobian, Simulator.run
    spoiling, spoiled = [False], []

    def part_of(y):
        if spoiling[0]:
            spoiled.append(value)
            y = np.array(y)
            y[len(y) // 2 :] = value
        return y

    def counted(self, candidate):
        # The third evaluation of every refit is a trial; those at its start and at its end are not.
        self.calls = getattr(self, "calls", 0) + 1
        spoiling[0] = self.calls == 3
        found = call(self, candidate)
        spoiling[0] = False
        return found

    def outputs(self, *rest):
        y, J = run_and_jacobian(self, *rest)
        return part_of(y), J

    monkeypatch.setattr(Equations, "__call__", counted)
    monkeypatch.setattr(Simulator, "run_and_jacobian", outputs)
    monkeypatch.setattr(Simulator, "run", lambda self, *rest: part_of(run(self, *rest)))
    # One refit at a time: which one is spoiled must not depend on threads.
    monkeypatch.setattr("jaxgray.numerics.programs.side_by_side.cores", lambda: 1)
    diagnosis = diagnosed(hidden_case("cubic_stiffness"), only=("cubic_stiffness", "quadratic_stiffness"))
    assert spoiled
    (found,) = model_findings(diagnosis)
    assert found.effect == "cubic_stiffness", str(diagnosis)
    assert all(np.isfinite(p.value) and np.isfinite(p.standard_error) for p in found.parameters.values())
    assert np.isfinite(diagnosis.excess)
