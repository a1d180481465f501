"""The array library itself, against NumPy: versions are known that return wrong rows."""

import importlib.metadata
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.numerics.programs import backend


def test_version_is_not_known_to_be_wrong():
    assert importlib.metadata.version("jax") not in ("0.10.2", "0.11.0")


@pytest.mark.parametrize("columns", [3, 5, 6])
def test_rowwise_products_agree_with_numpy(columns):
    rng = np.random.default_rng(columns)
    M = rng.standard_normal((columns, columns))
    rows = rng.standard_normal((20000, columns))
    # Compiled as users get it, not as the tests are.
    as_shipped = {"xla_backend_optimization_level": 3}
    found = jax.jit(jax.vmap(lambda row: jnp.sum((M @ row) ** 2)), compiler_options=as_shipped)(rows)
    np.testing.assert_allclose(found, np.sum((rows @ M.T) ** 2, axis=1), rtol=1e-10)


def test_few_cores_get_more_threads_unless_the_user_has_said_how_many(monkeypatch):
    monkeypatch.setattr(backend, "cores", lambda: 2)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setenv("NPROC", "")
    monkeypatch.delenv("NPROC")
    backend.widen()
    assert os.environ["NPROC"] == "4"
    monkeypatch.setenv("NPROC", "3")
    backend.widen()
    assert os.environ["NPROC"] == "3"
    monkeypatch.delenv("NPROC")
    monkeypatch.setattr(backend, "cores", lambda: 8)
    backend.widen()
    assert "NPROC" not in os.environ
    # Every host device waits for threads of its own.
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=4")
    backend.widen()
    assert os.environ["NPROC"] == "16"


@pytest.mark.parametrize(
    ("ask", "flag", "asked", "other"),
    [
        ("compile_sooner", "--xla_cpu_use_fusion_emitters", "false", "true"),
        (
            "run_sooner",
            "--xla_backend_extra_options",
            "xla_cpu_small_while_loop_byte_threshold=1000000000",
            "xla_cpu_optimize_for_size",
        ),
    ],
)
def test_flags_are_added_where_they_are_known_and_the_user_has_not_chosen(monkeypatch, ask, flag, asked, other):
    ask = getattr(backend, ask)
    monkeypatch.setattr(importlib.metadata, "version", lambda package: "0.10.1")
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    ask()
    assert os.environ["XLA_FLAGS"] == f"--xla_force_host_platform_device_count=2 {flag}={asked}"
    monkeypatch.setenv("XLA_FLAGS", f"{flag}={other}")
    ask()
    assert os.environ["XLA_FLAGS"] == f"{flag}={other}"
    monkeypatch.setenv("XLA_FLAGS", "/a/file/with/flags")
    ask()
    assert os.environ["XLA_FLAGS"] == "/a/file/with/flags"
    # A release that does not know the flag would end the process.
    monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setattr(importlib.metadata, "version", lambda package: "0.12.1")
    ask()
    assert "XLA_FLAGS" not in os.environ


def _set_by_import(before, **given):
    """What importing sets of the backend's environment, in a process that does something first."""
    code = f"import os, sys; {before}; import jaxgray; print(os.environ.get('NPROC'), os.environ.get('XLA_FLAGS'))"
    plain = {k: v for k, v in os.environ.items() if k not in ("NPROC", "XLA_FLAGS")}
    done = subprocess.run([sys.executable, "-c", code], env=plain | given, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_importing_sets_nothing_where_it_is_switched_off_or_arrays_are_there():
    few = "os.sched_getaffinity = lambda process: {0}"
    assert _set_by_import(few).startswith("4 ")
    assert _set_by_import(few, JAXGRAY_BACKEND="0") == "None None"
    assert _set_by_import(f"{few}; import jax.numpy; jax.numpy.ones(1)") == "None None"
