"""The array library itself, against NumPy: versions are known that return wrong rows."""

import importlib.metadata
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.numerics import threads


def test_version_is_not_known_to_be_wrong():
    assert importlib.metadata.version("jax") not in ("0.10.2", "0.11.0")


@pytest.mark.parametrize("columns", [3, 5, 6])
def test_rowwise_products_agree_with_numpy(columns):
    rng = np.random.default_rng(columns)
    M = rng.standard_normal((columns, columns))
    rows = rng.standard_normal((20000, columns))
    found = jax.jit(jax.vmap(lambda row: jnp.sum((M @ row) ** 2)))(rows)
    np.testing.assert_allclose(found, np.sum((rows @ M.T) ** 2, axis=1), rtol=1e-10)


def test_few_cores_get_more_threads_unless_the_user_has_said_how_many(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)
    monkeypatch.delenv("NPROC", raising=False)
    threads.widen()
    assert os.environ["NPROC"] == "4"
    monkeypatch.setenv("NPROC", "3")
    threads.widen()
    assert os.environ["NPROC"] == "3"
    monkeypatch.delenv("NPROC")
    monkeypatch.setattr(threads, "cores", lambda: 8)
    threads.widen()
    assert "NPROC" not in os.environ
