"""The local statistic of a record, against derivatives of the independent simulator."""

import fleet_records as made
import numpy as np
import pytest
from independent import REFERENCE, random_steps, sensitivities, simulate

from jaxgray import Record
from jaxgray.fleets.drift.score import score

SAMPLES = 400
OWN = {
    "mass": REFERENCE["M"].tolist(),
    "damping": REFERENCE["D"].tolist(),
    "stiffness": REFERENCE["K"].tolist(),
    "noise": [made.NOISE, 2 * made.NOISE],
}


@pytest.fixture(scope="module")
def inputs():
    return random_steps(np.random.default_rng(8), SAMPLES, 2, made.H, (0.2, 1.5))


def test_the_statistic_is_that_of_the_simulators_derivatives(inputs):
    K = REFERENCE["K"].copy()
    K[0, 0] *= 1.002
    y = simulate(REFERENCE["M"], REFERENCE["D"], K, inputs, made.H)
    found = score(Record(inputs, y + 0.01, made.H), OWN, effects=("coulomb_friction",))
    table = sensitivities(tuple(REFERENCE.values()), inputs, made.H) / np.array(OWN["noise"])[None, :, None]
    table = table.reshape(-1, table.shape[2])
    J, Z = table[:, :9], table[:, 9:]
    e = ((y - simulate(*REFERENCE.values(), inputs, made.H)) / OWN["noise"]).ravel()

    def off(x):
        return x - Z @ np.linalg.lstsq(Z, x, rcond=None)[0]

    F, s = np.array(found["information"])[:9, :9], np.array(found["score"])[:9]
    scale = np.linalg.norm(off(J), axis=0)
    # The free run starts where it fits best, which moves the derivatives a little.
    F_error = np.max(np.abs(F - off(J).T @ off(J)) / scale[:, None] / scale)
    s_error = np.max(np.abs(s - off(J).T @ e) / scale) / np.linalg.norm(off(e))
    assert F_error < 3e-3 and s_error < 3e-3, (F_error, s_error)
    # One step from the reference finds what is changed.
    step = np.linalg.solve(F, s)
    assert abs(step[6] - 0.2) < 0.01 and found["names"][6] == "stiffness[0,0]"
    assert [name for name in found["names"] if "friction" in name] == [
        f"coulomb_friction {place}" for place in ("y1", "y2", "y1-y2")
    ]
