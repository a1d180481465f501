"""The force equation on bodies without a spring to the ground, of more than one coordinate."""

import dataclasses
from types import SimpleNamespace

import hidden
import numpy as np
from independent import smooth_noise

from jaxgray import Record
from jaxgray.diagnosis.force_result import force_diagnosis
from jaxgray.diagnosis.force_route import _ordered
from jaxgray.diagnosis.force_search import search_forces
from jaxgray.mechanics.drives import Force
from jaxgray.mechanics.effects import by_id
from jaxgray.numerics.progress import Silent
from jaxgray.numerics.runtime import ready

T, SAMPLES = 0.005, 3000
LAWS = "constant_force", "dahl_friction", "coulomb_friction", "quadratic_drag", "asymmetric_friction"


def test_friction_of_two_bodies_that_drift_is_found_among_laws_that_explain_as_much():
    ready()
    rng = np.random.default_rng(8)
    M, D, K = np.diag([1.2, 0.8]), np.diag([0.6, 0.4]), 60.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    rubbing = (hidden.Effect("coulomb_friction", "y1", {"Fc": 1.5, "eps": 0.01}),)
    records = []
    for _ in range(2):
        u = 4.0 * smooth_noise(rng, SAMPLES, 2, bandwidth=0.02)
        y = hidden.simulate(hidden.System(M, D, K, np.eye(2)), u, T, rubbing, hold="linear")
        records.append(Record(u, y + rng.normal(scale=1e-4, size=y.shape), T, hold="linear"))
    laws = tuple(by_id(one) for one in LAWS)
    options = {"rng": np.random.default_rng(0), "progress": Silent()}
    search = search_forces(records[:1], records[1:], Force(np.eye(2)), laws, 2, **options)
    found = [f for f in force_diagnosis(search, None).findings if f.stage == "model"]
    assert [(f.effect, f.location) for f in found] == [("coulomb_friction", "y1")]
    assert abs(found[0].parameters["Fc"].value - 1.5) < 0.1
    assert found[0].gain.ci99_lower > 0
    # Of laws that explain as much the one of fewer parameters is judged first, wherever it stands.
    wide = dataclasses.replace(search.taken[0].trial, fit=dataclasses.replace(search.fit, moving=((0, 1),)))
    plain = dataclasses.replace(search.taken[0].trial, explained=0.9 * wide.explained)
    assert _ordered(SimpleNamespace(taken=[]), [wide, plain]) == [plain, wide]
