"""Identification of rows at times of their own, with data from the modes of the system."""

import independent as data
import numpy as np
import pytest

import jaxgray
from jaxgray.numerics.varying_steps import response, step_matrices
from jaxgray.records import Record

TRUTH = tuple(data.REFERENCE.values())


def generator(name):
    return np.random.default_rng(list(name.encode()))


def at_times(time, u):
    """Outputs of the reference system with inputs held from row to row, from its modes."""
    A, B = data.state_space(*TRUTH, np.eye(2))
    values, vectors = np.linalg.eig(A)
    drive = u @ np.linalg.solve(vectors, B.astype(complex)).T / values
    z, seen = np.zeros(4, complex), []
    for k, step in enumerate(np.exp(values * np.append(np.diff(time), 0.0)[:, None])):
        seen.append(z)
        z = step * (z + drive[k]) - drive[k]
    return (np.array(seen) @ vectors.T).real[:, :2]


def drawn(rng, kind, samples=2000, step=0.02):
    # Half as many where the grid is twice as fine: one length for all.
    time = np.cumsum(rng.exponential(step, samples // 2))
    if kind != "random":
        time = step * (np.arange(samples) + rng.uniform(-0.3, 0.3, samples))
    samples = len(time)
    u = data.random_steps(rng, samples, 2, step)
    return time, u, at_times(time, u)


def errors(found):
    return max(data.relative_errors((found.mass, found.damping, found.stiffness), TRUTH))


@pytest.mark.parametrize("kind", ["jittered", "random", "rates"])
def test_without_noise_the_truth_is_found(kind):
    time, u, y = drawn(generator(kind), kind)
    if kind == "rates":
        y = np.where(np.arange(2000)[:, None] % [1, 3] == 0, y, np.nan)
    found = jaxgray.identify(Record.from_stamps(time, u, y))
    assert errors(found) < 1e-9
    assert "The rows have times of their own" in found.warnings[0]


def test_with_noise_the_errors_are_those_of_the_interval():
    rng = generator("noise")
    time, u, y = drawn(rng, "jittered")
    record = Record.from_stamps(time, u, y + 1e-4 * rng.standard_normal(y.shape))
    found, before = jaxgray.identify(record), jaxgray.identify(record.on_grid)
    upper = np.triu_indices(2)
    for name, X in zip(("mass", "damping", "stiffness"), TRUTH):
        off = (getattr(found, name) - X)[upper] / found.standard_errors[name][upper]
        assert np.all(np.abs(off) < 4)
    assert found.estimation[0].rmse.max() < 1.03e-4 < 1.1e-4 < before.estimation[0].rmse.max()


def test_times_of_the_logger_are_told_from_those_of_the_samples():
    rng = generator("logger")
    u = data.random_steps(rng, 2000, 2, 0.02)
    y = data.simulate(*TRUTH, u, 0.02) + 3e-4 * rng.standard_normal((2000, 2))
    time = 0.02 * (np.arange(2000) + rng.uniform(-0.3, 0.3, 2000))
    found = jaxgray.identify(Record.from_stamps(time, u, y))
    assert "are not those at which they were sampled" in found.warnings[0] and errors(found) < 0.02


def test_held_out_rows_and_several_records():
    rng = generator("several")
    records = []
    for _ in range(2):
        time, u, y = drawn(rng, "jittered")
        records.append(Record.from_stamps(time, u, y + 1e-4 * rng.standard_normal(y.shape)))
    time, u, y = drawn(rng, "jittered")
    y = y + 1e-4 * rng.standard_normal(y.shape)
    found = jaxgray.identify(records, validation=Record.from_stamps(time, u, y))
    assert errors(found) < 2e-3
    np.testing.assert_allclose([fit.rmse for fit in found.validation], 1e-4, rtol=0.15)


def test_a_clock_beside_that_of_the_inputs_is_mended():
    rng, h, late, rate = generator("clocks"), 0.02, 0.006, 2e-4
    events = np.arange(0, 40, h)
    u = data.random_steps(rng, len(events), 2, h)
    seen = np.arange(0.2 * h, 39, h)
    every = np.unique(np.concatenate([events, seen]))
    y = at_times(every, u[np.searchsorted(events, every, side="right") - 1])[np.searchsorted(every, seen)]
    time = np.concatenate([events, (seen - late) / (1 + rate)])
    order = np.argsort(time, kind="stable")
    held = u[np.maximum(np.searchsorted(events, time[order], side="right") - 1, 0)]
    outputs = np.concatenate([np.full((len(events), 2), np.nan), y + 1e-4 * rng.standard_normal(y.shape)])
    clock = np.repeat([0, 1], [len(events), len(seen)])
    record = Record.from_stamps(time[order], held, outputs[order], clock=clock[order])
    found = jaxgray.identify(record)
    (one,) = found.clocks
    assert one.outputs == ("y1", "y2") and abs(one.rate - rate) < 4 * one.rate_error < 0.2 * rate
    assert abs(one.offset - late - rate * record.start_time) < 4 * one.offset_error < 0.2 * late
    assert errors(found) < 0.02 and any("The clock of y1, y2 is set +0." in text for text in found.warnings)


def test_steps_of_any_length():
    rng = generator("steps")
    A = np.array([[0.0, 1.0], [-4.0, -0.3]])
    lengths = np.append(rng.exponential(0.2, 50), 0.0)
    values, vectors = np.linalg.eig(A)

    def flow(length):
        return (vectors @ np.diag(np.exp(values * length)) @ np.linalg.inv(vectors)).real

    found = step_matrices(lambda many: np.stack([flow(one) for one in many]), lengths)
    np.testing.assert_allclose(found, [flow(one) for one in lengths], atol=1e-12)
    forced = rng.standard_normal((51, 2))
    P, x = response(found, forced)
    state, product = np.zeros(2), np.eye(2)
    for k in range(51):
        state, product = found[k] @ state + forced[k], found[k] @ product
        np.testing.assert_allclose(x[k], state, atol=1e-12)
    np.testing.assert_allclose(P[-1], product, atol=1e-12)
