"""Steps and ramps in series: dated, sized, and rarely seen where there is none."""

import numpy as np
import pytest
import scipy.stats

from jaxgray.fleets.drift.changes import change_of, conditions, curve, shapes_of
from jaxgray.fleets.drift.machines import Machine, drifts_of
from jaxgray.fleets.population import discoveries, outliers, trends

RECORDS = 40


@pytest.fixture(scope="module")
def temperature():
    rng = np.random.default_rng(1)
    return 20 + 10 * np.sin(np.arange(RECORDS) / 6.0) + rng.standard_normal(RECORDS)


@pytest.fixture(scope="module")
def shapes(temperature):
    return shapes_of(conditions(temperature[:, None]), np.ones(RECORDS))


def test_without_a_change_the_probability_is_even(temperature, shapes):
    rng = np.random.default_rng(2)
    p = []
    for _ in range(400):
        x = 5 + 0.3 * temperature + 0.01 * temperature**2 + rng.uniform(0.1, 9.0) * rng.standard_normal(RECORDS)
        p.append(change_of(x, shapes).probability)
    assert scipy.stats.kstest(p, "uniform").pvalue > 1e-3


def test_far_probabilities_fall_on(shapes):
    p = [shapes.probability(t) for t in (5.0, 10.0, 20.0, 40.0)]
    assert np.all(np.diff(np.log(p)) < -3) and 0 < p[-1] < 1e-12


@pytest.mark.parametrize("kind, begins", [("step", 8), ("step", 25), ("ramp", 20)])
def test_a_change_is_dated_and_sized(kind, begins, temperature, shapes):
    rng = np.random.default_rng(3)
    x = 5 + 0.3 * temperature + 8.0 * curve(kind, begins, RECORDS) + 0.5 * rng.standard_normal(RECORDS)
    found = change_of(x, shapes)
    assert found.kind == kind and abs(found.begins - begins) <= 2 and found.probability < 1e-9
    assert found.interval[0] <= begins <= found.interval[1]
    assert abs(found.size - 8.0 * curve(kind, begins, RECORDS)[-1]) < 4 * found.standard_error


def test_what_the_covariate_does_is_no_change(temperature):
    rising = np.arange(RECORDS, dtype=float)
    shapes = shapes_of(conditions(rising[:, None]), np.ones(RECORDS))
    x = 3 * rising + np.random.default_rng(4).standard_normal(RECORDS)
    assert change_of(x, shapes).probability > 1e-3
    constant = np.full((RECORDS, 1), 7.0)
    assert conditions(constant).shape == (RECORDS, 1)


def test_false_discoveries_are_few():
    rng = np.random.default_rng(5)
    shares = []
    for _ in range(300):
        p = np.concatenate([rng.uniform(size=95), rng.uniform(size=5) * 1e-5])
        kept = discoveries(p, 0.05)
        assert kept[95:].all()
        shares.append(kept[:95].sum() / kept.sum())
    assert np.mean(shares) < 0.06
    assert not discoveries(np.array([0.5, 0.2]), 0.05).any()


def made_machine(rng, name, *, step=0.0, wear=0.0, temperature=None):
    """Scores of a machine as a linear problem makes them: 9 entries and 3 effects, directions at random."""
    J = np.random.default_rng(9).standard_normal((200, 12))
    # The second effect looks much like damping and like the first.
    J[:, 10] = 0.7 * J[:, 9] + 0.5 * J[:, 3] + 0.3 * J[:, 10]
    names = [f"{m}[{r},{c}]" for m in ("mass", "damping", "stiffness") for r, c in ((0, 0), (0, 1), (1, 1))]
    names += ["coulomb_friction y1", "quadratic_drag y1", "cubic_stiffness y2"]
    documents = []
    for k in range(RECORDS):
        truth = np.zeros(12)
        truth[6] = step * (k >= 17)
        truth[9] = wear * max(k - 24, 0)
        truth[8] = 0.2 * (temperature[k] - 20) * 0.05
        e = J @ truth + rng.standard_normal(200)
        documents.append({"names": names, "entries": 9, "score": J.T @ e, "information": J.T @ J})
    reference = {"mass": np.eye(2), "damping": np.eye(2), "stiffness": 50 * np.eye(2)}
    files = tuple(f"{name}_{k}" for k in range(RECORDS))
    when = tuple(str(k) for k in range(RECORDS))
    return Machine(name, files, when, temperature[:, None], (reference,) * RECORDS, (1.0, 1.0), ("y1", "y2")), documents


def test_machines_that_change_are_named_and_others_are_not(temperature):
    rng = np.random.default_rng(6)
    changed = {"m3": {"step": 0.5}, "m5": {"wear": 0.05}}
    made = [made_machine(rng, f"m{k}", temperature=temperature, **changed.get(f"m{k}", {})) for k in range(12)]
    found = {(one.machine, one.name): one for one in drifts_of([m for m, _ in made], [d for _, d in made])}
    assert set(found) == {("m3", "stiffness[0,0]"), ("m5", "coulomb_friction y1")}
    step, wear = found["m3", "stiffness[0,0]"], found["m5", "coulomb_friction y1"]
    assert step.change.kind == "step" and abs(step.change.begins - 17) <= 2 and step.since == "m3_17"
    assert abs(step.relative - 0.01) < 4 * step.change.standard_error / 50
    assert wear.change.kind == "ramp" and abs(wear.change.begins - 25) <= 2
    assert abs(wear.change.size - 0.05 * 15) < 4 * wear.change.standard_error
    assert "stiffness y1 of m3 rises from record 18 on" in step.sentence
    assert "Coulomb friction at y1 of m5 begins and grows from record" in wear.sentence


def test_outliers_and_trends_of_a_population():
    rng = np.random.default_rng(7)
    rows = [
        {"file": f"f{k}", "when_number": float(k), "mass_y1": 5 + 0.01 * rng.standard_normal(), "mass_y1_error": 0.01}
        | {"stiffness_y1": 100 + 0.05 * k + 0.2 * rng.standard_normal(), "stiffness_y1_error": 0.2}
        for k in range(30)
    ]
    rows[11]["mass_y1"] = 5.5
    assert [(one.row["file"], one.parameter) for one in outliers(rows)] == [("f11", "mass_y1")]
    (found,) = trends(rows)
    assert found.parameter == "stiffness_y1" and found.interval[0] < 0.05 < found.interval[1]
