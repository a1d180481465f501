"""Records that hold too little, or nothing to find: one clear sentence, and no finding out of rounding."""

import hidden
import numpy as np
import pytest
from found import SAMPLES, generator
from independent import smooth_noise

import jaxgray
from jaxgray.diagnosis import routing as routes
from jaxgray.identification.validation.structure_test import structure_test
from jaxgray.numerics.outcomes import RESULTS


def record(*missing, samples=SAMPLES):
    case = hidden.null_case(generator("enough"), "white", dofs=(2,), samples=SAMPLES)
    y = np.array(case.y)
    for where in missing:
        y[where] = np.nan
    return jaxgray.Record(case.u[:samples], y[:samples], case.sampling_time, hold=case.hold)


def test_outputs_that_are_never_known_together_are_refused():
    with pytest.raises(ValueError, match="50 % of the outputs' samples are missing, and hardly anywhere are 11 in"):
        jaxgray.diagnose(record((slice(1, None, 2), 0), (slice(None, None, 2), 1)))


def test_a_record_with_a_gap_every_tenth_sample_is_refused_and_not_called_noise():
    with pytest.raises(ValueError, match="10 % of the outputs' samples are missing.*fill short gaps by interpolation"):
        jaxgray.diagnose(record(slice(None, None, 10)))


@pytest.mark.parametrize("use", [jaxgray.identify, jaxgray.diagnose])
def test_an_output_that_was_not_measured_in_one_record_is_named(use):
    with pytest.raises(ValueError, match=r"records\[1\] has no measured sample of 'y2' \(.* all missing\)"):
        use([record(), record((slice(None), 1))])


def test_an_input_that_never_moves_is_named_whatever_is_looked_for():
    still = record()
    with pytest.raises(jaxgray.ComputationError, match="input 'u1' is constant .0."):
        jaxgray.diagnose(jaxgray.Record(0.0 * still.u, still.y, still.sampling_time))


def test_a_free_run_serves_where_the_force_equation_has_no_solution(monkeypatch):
    def unsolved(*_, **__):
        raise jaxgray.ComputationError(RESULTS.nonfinite, stage="force equation")

    monkeypatch.setattr(routes, "route_of", lambda *_: "force equation")
    monkeypatch.setattr(routes, "search_forces", unsolved)
    diagnosis = jaxgray.diagnose(record(), only=["cubic_stiffness"])
    assert diagnosis.verdict == "noise" and not any("force equation" in text for text in diagnosis.warnings)


def test_a_validation_record_of_a_few_samples_is_refused():
    with pytest.raises(ValueError, match=r"validation\[0\] has 10 samples; give at least 20, or no validation"):
        jaxgray.diagnose(record(), validation=record(samples=10))


def quasi_static(response):
    """A record of one sine that the motion follows at once."""
    t = 0.01 * np.arange(1500)
    u = np.sin(2 * np.pi * 0.5 * t)[:, None]
    return jaxgray.Record(u, response(u), 0.01)


def test_a_static_record_without_error_has_nothing_to_find():
    diagnosis = jaxgray.diagnose(quasi_static(lambda u: 2.0 * u))
    assert diagnosis.verdict == "noise" and not diagnosis.findings, str(diagnosis)


@pytest.mark.slow
def test_a_static_record_with_a_loop_is_not_noise_where_no_effect_may_be_added():
    noise = 1e-3 * generator("loop").standard_normal((1500, 1))
    diagnosis = jaxgray.diagnose(quasi_static(lambda u: np.roll(u, 4, axis=0) + noise), max_effects=0)
    assert diagnosis.verdict == "unexplained", str(diagnosis)


def test_a_free_run_that_overflows_has_no_structure_to_test():
    u = smooth_noise(generator("overflow"), 200, 1)
    with pytest.raises(jaxgray.ComputationError, match="the free run overflows"):
        structure_test(u, np.full((200, 1), np.nan), np.ones((200, 1, 3)), u, np.eye(2), direct=False)
