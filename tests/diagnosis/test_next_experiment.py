"""The next experiment: proposed where it separates the laws of a class, under their names, and not elsewhere."""

from types import SimpleNamespace

import numpy as np
import pytest
from found import generator

from jaxgray import Record
from jaxgray.diagnosis.conclusions.next_experiment import LONGEST, next_experiment
from jaxgray.diagnosis.model.candidate import Candidate, Data
from jaxgray.diagnosis.model.simulator import Simulator, Steps
from jaxgray.numerics.progress import Silent

SAMPLES, FLOOR = 1200, 1e-3


class Curve:
    """Answers u + c u³, c being the one entry of a candidate; its slope by a gain that any member may have."""

    @property
    def coarse(self):
        return self

    def run(self, candidate, data, k=0):
        (c,) = candidate.entries
        return data.u + c * data.u**3

    def run_and_jacobian(self, candidate, data, k=0):
        return self.run(candidate, data), data.u[:, :, None]


def proposed(c, samples=SAMPLES):
    """For two members that differ by a cube of c, where the record moves within a tenth of its peak but once."""
    rng = generator("experiment")
    u = 0.1 * rng.uniform(-1, 1, (samples, 1))
    u[0] = 1.0
    record = Record(u, u, 0.01)
    data = Data.of(record)
    members = [Candidate(np.array([value]), (np.zeros(2),), ()) for value in (0.0, c)]
    context = SimpleNamespace(simulator=Curve(), data=[data], validation=[], rng=rng)
    return next_experiment(
        context, members, ("cubic_stiffness", "sine_stiffness"), record, np.array([FLOOR]), progress=Silent()
    )


def test_an_input_that_separates_two_laws_is_proposed_under_their_names():
    found = proposed(0.01)
    assert found.members == ("cubic_stiffness", "sine_stiffness") and "cubic_stiffness and sine_stiffness" in found.text
    assert found.separation > 9 and found.separation > 1.5 * found.separation_now
    assert np.max(np.abs(found.input)) <= 1.0 + 1e-12


def test_an_experiment_takes_no_steps_as_short_as_noise_asks_for():
    fine, short = (Simulator("setup", ("law",), steps=steps) for steps in (Steps(8, True), Steps(4, True)))
    coarse = fine.coarse
    assert (coarse.steps, coarse.setup, coarse.laws) == (Steps(8), "setup", ("law",)) and fine.steps == Steps(8, True)
    assert short.coarse is short and coarse.coarse is coarse


def test_an_experiment_is_no_longer_than_it_need_be():
    found = proposed(0.01, 3 * LONGEST)
    assert len(found.input) == LONGEST and f"{LONGEST} samples" in found.text and found.separation > 9


@pytest.mark.parametrize("c", [0.0, 1e-5])
def test_what_no_input_separates_is_not_promised_to_be(c):
    assert proposed(c) is None
