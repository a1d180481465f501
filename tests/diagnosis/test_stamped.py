"""Records of rows at times of their own: laws are found as at uniform times."""

import hidden
import hidden_simulation
import numpy as np
import pytest
from found import generator

import jaxgray
from jaxgray.records import Record

FINE = 20


def rows_of(case, rng, wander=0.3):
    """Rows that wander, with inputs held from each on, by the independent simulator on a finer grid."""
    samples, h = len(case.u), hidden.SAMPLING_TIME / FINE
    at = FINE * np.arange(samples) + np.rint(rng.uniform(-wander, wander, samples) * FINE).astype(int)
    at = np.maximum(at, 0)
    u = case.u[np.searchsorted(at, np.arange(at[-1] + 1), side="right").clip(1) - 1]
    clean = hidden_simulation.simulate(case.system, u, h, case.effects, hold="zero")[at]
    return Record.from_stamps(at * h, case.u, clean + case.noise * rng.standard_normal(clean.shape))


def test_a_hidden_law_is_named_with_its_size():
    law, size = "coulomb_friction", "Fc"
    rng = generator("rows", law)
    case = hidden.random_case(rng, law, dofs=(1,), samples=1500, excess=(3.0, 6.0))
    record = rows_of(case, rng)
    found = jaxgray.diagnose(record, only=[law, "input_delay", "force_step", "quadratic_drag"])
    assert [(f.effect, f.location) for f in found.findings] == [(law, case.effects[0].place)]
    value = found.findings[0].parameters[size]
    assert abs(value.value - case.effects[0].parameters[size]) < 4 * value.standard_error
    assert "The rows have times of their own" in found.warnings[0]


def test_nothing_is_found_where_nothing_is_hidden():
    rng = generator("rows", "none")
    found = jaxgray.diagnose(rows_of(hidden.null_case(rng, "white", dofs=(1,), samples=1500), rng))
    assert found.verdict == "noise"


def test_a_simulator_at_uniform_times_is_refused():
    rng = generator("rows", "refused")
    record = rows_of(hidden.null_case(rng, "white", dofs=(1,), samples=300), rng)
    with pytest.raises(ValueError, match="simulator runs at a uniform sampling time"):
        jaxgray.diagnose(record, simulator=lambda u, w, numbers: u)
