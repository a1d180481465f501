"""Many records side by side: the same answers as one by one, and an honest outcome for each."""

import os
import subprocess
import sys
import textwrap

import independent as data
import numpy as np
import pytest

from jaxgray import RESULTS, Record, identify, identify_many

H = data.REFERENCE_TIME * 4
OPTIONS = {"time_constants": 0.1, "block_rows": 6}


def record_of(seed, samples):
    """A specimen: the reference system with matrices of its own, not at rest, with an offset."""
    rng = np.random.default_rng(seed)
    u = data.random_steps(rng, samples, 2, H, (0.2, 1.5))
    truth = [X * f for X, f in zip(data.REFERENCE.values(), 1 + 0.1 * rng.standard_normal(3))]
    y = data.simulate(*truth, u, H, x0=0.01 * rng.standard_normal(4)) + 0.002
    return truth, Record(u, y + data.REFERENCE_NOISE * rng.standard_normal(y.shape), H)


@pytest.fixture(scope="module")
def records():
    found = [record_of(k, 4000 - 150 * k)[1] for k in range(4)]
    y = np.array(found[1].y)
    y[100:130, 0] = np.nan
    found[1] = Record(found[1].u, y, H)
    rng = np.random.default_rng(9)
    found.append(Record(found[0].u, np.ones_like(found[0].y), H))
    found.append(Record(found[0].u, rng.standard_normal(found[0].y.shape), H))
    return found


@pytest.fixture(scope="module")
def batch(records):
    return identify_many(records, **OPTIONS, alone=False)


def test_every_record_has_the_model_it_would_have_alone(records, batch):
    for k, record in enumerate(records[:4]):
        assert batch.results[k] == RESULTS.successful
        single = identify(record, **OPTIONS)
        for name in ("mass", "damping", "stiffness"):
            error = single.standard_errors[name]
            assert np.max(np.abs(getattr(batch, name)[k] - getattr(single, name)) / error) < 1e-3
            np.testing.assert_allclose(batch.standard_errors[name][k], error, rtol=1e-3)
        np.testing.assert_allclose(batch.rmse[k], list(single.rmse["estimation"].values()), rtol=1e-3)
        assert batch.white[k]


def test_errors_are_as_large_as_said(batch):
    for k in range(4):
        for name, X in zip(("mass", "damping", "stiffness"), record_of(k, 4000 - 150 * k)[0]):
            assert np.max(np.abs(getattr(batch, name)[k] - X) / batch.standard_errors[name][k]) < 5


def test_what_fails_says_so(records, batch):
    assert not batch.successful[4:].any()
    assert batch.results[4] == RESULTS.not_exciting and np.isnan(batch.mass[4]).all()
    assert "constant" in batch.details[4]
    with pytest.raises(ValueError, match="record 4 has no model: .*constant"):
        batch.model(4)
    assert batch.model(0).dofs == 2
    text = repr(batch)
    assert "4 of 6 records" in text and "record 5" in text


@pytest.mark.slow
def test_what_the_batch_leaves_is_identified_alone(records):
    """A mode without damping lies at the edge of the cone, where Cholesky factors cannot judge their end."""
    rng = np.random.default_rng(0)
    truth = data.REFERENCE | {"D": np.array([[2.0, -2.0], [-2.0, 2.0]])}
    y = data.simulate(*truth.values(), records[0].u, H)
    edge = Record(records[0].u, y + data.REFERENCE_NOISE * rng.standard_normal(y.shape), H)
    found = identify_many([records[0], edge], **OPTIONS)
    assert found.successful.all() and list(found.alone) == [False, True]
    single = identify(edge)
    assert data.relative_errors([found.damping[1]], [single.damping])[0] < 1e-3


def test_records_that_do_not_go_together_are_named(records):
    with pytest.raises(ValueError, match="non-empty list of Record"):
        identify_many([])
    with pytest.raises(ValueError, match="time_constants=-1"):
        identify_many(records[:2], time_constants=-1.0)
    with pytest.raises(ValueError, match=r"records\[1\] has measured"):
        identify_many([records[0], Record(records[0].u, records[0].y, H, measured="velocity")])


@pytest.mark.parametrize("devices", [4])
def test_sharing_the_work_changes_nothing(devices, records, batch, tmp_path):
    np.savez(tmp_path / "in.npz", *[np.hstack([r.u, r.y]) for r in records[:4]])
    script = f"""
        import os
        os.environ["JAX_PLATFORMS"] = "cpu"
        os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count={devices}"
        import jax, numpy as np
        jax.config.update("jax_enable_x64", True)
        import jaxgray
        assert jax.local_device_count() == {devices}
        parts = np.load(r"{tmp_path / "in.npz"}")
        records = [jaxgray.Record(parts[n][:, :2], parts[n][:, 2:], {H}) for n in parts.files]
        found = jaxgray.identify_many(records, time_constants=0.1, block_rows=6, alone=False)
        assert found.successful.all()
        np.savez(r"{tmp_path / "out.npz"}", **{{n: getattr(found, n) for n in ("mass", "damping", "stiffness")}})
    """
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    subprocess.run([sys.executable, "-c", textwrap.dedent(script)], env=environment, check=True, timeout=400)
    found = np.load(tmp_path / "out.npz")
    for name in found.files:
        np.testing.assert_allclose(found[name], getattr(batch, name)[:4], rtol=1e-10)
