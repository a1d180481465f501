"""Programs kept on disk: a new process finds them without tracing, and nothing foreign or stale is ever run."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.mechanics.effects.base import Place
from jaxgray.numerics.programs import stored_programs
from jaxgray.numerics.programs.backend import flags_are_known
from jaxgray.numerics.programs.kept_files import MAGIC, private_folder, read_kept, write_kept
from jaxgray.numerics.programs.stored_programs import StoredProgram

traced = []


def spring(place, matrices, *, power):
    traced.append(place)
    M, K = matrices
    return {"values": jnp.linalg.eigvalsh(jnp.linalg.solve(M, K)) ** power, "place": (jnp.asarray(place.first),)}


class Mine(eqx.Module):
    """Not of the package."""

    first: int = eqx.field(static=True, default=0)


loaded = []


def note():
    loaded.append(True)


class Loaded:
    """Tells that it was unpickled."""

    def __reduce__(self):
        return note, ()


HERE = Place("y1", 0)
M, K = np.diag([2.0, 2.0]), np.array([[2.0, -1.0], [-1.0, 2.0]])


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    if not flags_are_known():
        pytest.skip("programs are stored with the releases of jaxlib alone that this was tried with")
    programs = private_folder(tmp_path / "programs")
    monkeypatch.setattr(stored_programs, "_folder", lambda: programs)
    traced.clear()
    return programs


def values(place=HERE, *, power=1):
    return StoredProgram(spring)(place, (M, K), power=power)


def test_another_process_runs_it_untraced(folder):
    first = values()
    assert len(traced) == 1 and len(list(folder.iterdir())) == 1
    again = values()
    assert len(traced) == 1
    assert jax.tree_util.tree_structure(first) == jax.tree_util.tree_structure(again)
    np.testing.assert_array_equal(first["values"], again["values"])
    np.testing.assert_allclose(again["values"], np.linalg.eigvalsh(np.linalg.solve(M, K)), rtol=1e-12)


@pytest.mark.parametrize("kept", [True, False])
def test_a_level_of_its_own_serves_inside_of_a_larger_program(folder, monkeypatch, kept):
    if not kept:
        monkeypatch.setattr(stored_programs, "_folder", lambda: None)
    program = StoredProgram(spring, level=stored_programs.ONCE)
    wanted = np.linalg.eigvalsh(np.linalg.solve(M, K))
    by_constants = jax.jit(lambda x: x * program(HERE, (M, K), power=1)["values"])
    by_arguments = jax.jit(lambda K: program(HERE, (M, K), power=1)["values"])
    along = jax.vmap(lambda K: program(HERE, (M, K), power=1)["values"])
    for found in (by_constants(1.0), by_arguments(K), along(K[None])[0], program(HERE, (M, K), power=1)["values"]):
        np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_threads_that_want_the_same_program_compile_it_once(folder):
    program = StoredProgram(spring)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: program(HERE, (M, K), power=1)["values"], range(4)))
    assert len(traced) == 1 and len(list(folder.iterdir())) == 1
    np.testing.assert_allclose(found, [np.linalg.eigvalsh(np.linalg.solve(M, K))] * 4, rtol=1e-12)


def test_threads_that_compile_at_once_leave_the_settings_as_they_were(folder):
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    program = StoredProgram(spring)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda power: program(HERE, (M, K), power=power), range(1, 5)))
    assert len(traced) == 4 and len(list(folder.iterdir())) == 4
    assert jax.config.jax_persistent_cache_min_compile_time_secs == before


def test_what_is_static_and_the_surroundings_belong_to_the_key(folder, monkeypatch):
    values()
    np.testing.assert_allclose(values(power=2)["values"], values()["values"] ** 2)
    assert values(Place("y2", 1))["place"][0] == 1
    assert len(traced) == 3 and len(list(folder.iterdir())) == 3
    monkeypatch.setattr(stored_programs, "_surroundings", lambda: b"other sources")
    values()
    assert len(traced) == 4 and len(list(folder.iterdir())) == 4


def test_foreign_classes_are_not_stored(folder):
    assert values(Mine(1))["place"][0] == 1
    assert not list(folder.iterdir())


@pytest.mark.parametrize("damage", ["cut", "flipped", "another's", "no program", "a pickle"])
def test_what_cannot_be_read_is_made_again(folder, damage):
    first = values()["values"]
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    if damage == "cut":
        path.write_bytes(whole[:100])
    elif damage == "flipped":
        path.write_bytes(whole[:-200] + bytes([whole[-200] ^ 1]) + whole[-199:])
    elif damage == "another's":
        values(power=2)
        (other,) = (one for one in folder.iterdir() if one != path)
        path.write_bytes(other.read_bytes())
    elif damage == "no program":
        # Whole, and yet nothing that the loader can read.
        write_kept(path, read_kept(path)[:-100])
    else:
        path.write_bytes(pickle.dumps(Loaded()))
    traced.clear()
    for _ in range(2):
        np.testing.assert_array_equal(values()["values"], first)
    assert len(traced) == 1 and path.read_bytes()[: len(MAGIC)] == MAGIC and not loaded


def test_folders_that_others_may_write_to_keep_no_programs(tmp_path):
    with pytest.warns(UserWarning, match="others may write to .* compiled programs are not kept there"):
        tmp_path.chmod(0o777)
        assert stored_programs._below(str(tmp_path)) is None
    assert not (tmp_path / stored_programs.FOLDER).exists()
    # Once.
    assert stored_programs._below(str(tmp_path)) is None


def test_traced_arguments_go_through(folder):
    slope = jax.grad(lambda k: jnp.sum(StoredProgram(spring)(HERE, (jnp.asarray(M), k * K), power=1)["values"]))(1.0)
    assert slope == pytest.approx(np.trace(np.linalg.solve(M, K)))
    assert not list(folder.iterdir())


def test_a_cache_that_is_not_on_this_machine_gets_no_folder_here(tmp_path, monkeypatch):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    assert stored_programs.programs_folder("gs://bucket/cache") is None
    assert not list(here.iterdir())
