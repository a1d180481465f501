"""Identification of rows at times of their own, with data from the modes of the system."""

import independent as data
import numpy as np
import pytest

import jaxgray
from jaxgray.identification.validation.residuals import noise_floor
from jaxgray.mechanics.at_stamps import about
from jaxgray.numerics.responses.varying_steps import response, step_matrices
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


@pytest.mark.parametrize("kind", ["jittered", pytest.param("random", marks=pytest.mark.slow), "rates"])
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


def test_what_a_wrong_model_leaves_is_moved_to_the_places_on_the_grid():
    time, u, y = drawn(generator("wrong"), "jittered")
    record = Record.from_stamps(time, u, y)
    every = np.unique(np.concatenate([time, record.time]))
    clean = at_times(every, u[(np.searchsorted(time, every, side="right") - 1).clip(0)])
    there = clean[np.searchsorted(every, record.time)]
    wrong = jaxgray.MechanicalModel(TRUTH[0], TRUTH[1], 1.2 * TRUTH[2])
    inside = slice(20, -20)
    off = [np.std((r.y - there)[inside], axis=0) for r in (about(wrong, record), record.on_grid)]
    assert np.all(off[0] < 0.1 * off[1])


def test_the_noise_of_a_slow_residual_is_seen_across_gaps():
    rng = generator("gaps")
    slow = np.sin(2 * np.pi * np.arange(4000) / 1000)[:, None]
    left = slow + 0.05 * rng.standard_normal((4000, 1))
    gaps = np.where(rng.random((4000, 1)) < 0.4, np.nan, left)
    assert noise_floor(gaps) == pytest.approx(noise_floor(left), rel=0.05)


@pytest.fixture(scope="module")
def jittered():
    rng, records = generator("batch"), []
    for _ in range(2):
        time, u, y = drawn(rng, "jittered")
        records.append(Record.from_stamps(time, u, y + 1e-4 * rng.standard_normal(y.shape)))
    return records


def test_a_batch_finds_what_records_one_by_one_do(jittered):
    records = [*jittered, jittered[0].on_grid]
    together = jaxgray.identify_many(records)
    assert together.successful.all() and not together.alone.any()
    for k, record in enumerate(records):
        alone = jaxgray.identify(record)
        for name in ("mass", "damping", "stiffness"):
            apart = (getattr(together, name)[k] - getattr(alone, name)) / alone.standard_errors[name]
            assert np.max(np.abs(apart)) < 0.1
    assert "The rows have times of their own" in together.details[0] and not together.details[2]


def test_a_sweep_looks_at_the_rows_at_their_own_times(jittered):
    choice = {"time_constants": 0.05, "block_rows": 8}
    found = jaxgray.sweep(jittered[0], validation=jittered[1], **choice)
    before = jaxgray.sweep(jittered[0].on_grid, validation=jittered[1].on_grid, **choice)
    assert np.all(100 - found.fit_percent < 0.7 * (100 - before.fit_percent))
    assert np.all(100 - found.validation_fit_percent < 0.7 * (100 - before.validation_fit_percent))
    poles = jaxgray.stabilisation(jittered[0], orders=[2, 4])
    truth = np.sort(np.sqrt(np.linalg.eigvals(np.linalg.solve(TRUTH[0], TRUTH[2])).real)) / (2 * np.pi)
    assert poles.frequency_hz[poles.order == 4] == pytest.approx(truth, rel=2e-3)
