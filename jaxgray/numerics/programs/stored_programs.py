"""Compiled programs kept on disk whole, so that a new process need not trace and lower them to find them.

The compilation cache of jax is asked with the lowered program, and to trace and lower the programs of a diagnosis takes
longer than to run them. Here the key is what a program is made from: the sources of this package, releases, flags and
machine, what is static in the arguments, shapes and types of the arrays. Where there is no folder for the cache, and
wherever anything here fails, all is as with `equinox.filter_jit`.
"""

import functools
import hashlib
import importlib.metadata
import io
import json
import os
import pathlib
import pickle
import threading
import warnings
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
from jax.experimental import serialize_executable

from .backend import flags_are_known, processor
from .kept_files import NotPrivate, private_folder, read_kept, write_kept
from .read_ahead import ReadAhead
from .result_forms import form_of, form_text

FOLDER = "jaxgray-programs"
"""Below the folder of jax's compilation cache."""

SWITCH = "JAXGRAY_PROGRAMS"
"""Environment variable; 0 keeps nothing. Whoever changes the package compiles less with jax's cache alone."""

OURS = frozenset({"jaxgray", "jax", "jaxlib", "equinox", "numpy", "builtins", "copyreg", "collections", "functools"})
"""Packages whose code a key vouches for, by their release or by the sources; a user's own class may change unseen."""

RELEASES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxopt", "numpy", "scipy")
"""Packages whose code or constants a program may contain."""

ONCE, OFTEN = 0, 2
"""Levels of optimisation. Without any, a program compiles in a quarter of the time and runs twice as long; beyond 2 it
compiles for longer and runs no faster."""

_everyone: list["StoredProgram"] = []


class _Array:
    """Stands in the arguments for an array."""

    def __reduce__(self):
        return _Array, ()


class _Foreign(Exception):
    """Something static is not of the packages that the key vouches for."""


class _Pickler(pickle.Pickler):
    """Bytes that depend on values alone, of nothing but known classes and functions."""

    def reducer_override(self, obj):
        # Classes and functions have one.
        if hasattr(obj, "__qualname__"):
            module = getattr(obj, "__module__", None) or "builtins"
            if module.split(".")[0] not in OURS or "<locals>" in obj.__qualname__:
                raise _Foreign(f"{module}.{obj.__qualname__}")
        return NotImplemented


def _bytes_of(tree) -> bytes:
    stream = io.BytesIO()
    pickler = _Pickler(stream, protocol=5)
    # Without the memory of objects seen before: equal values give equal bytes, shared or not.
    pickler.fast = True
    pickler.dump(tree)
    return stream.getvalue()


@functools.cache
def _surroundings() -> bytes:
    """What every program depends on: sources, releases, flags and machine."""
    digest = hashlib.sha256()
    root = pathlib.Path(__file__).resolve().parents[2]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    device = jax.local_devices()[0]
    versions = [(name, importlib.metadata.version(name)) for name in RELEASES] + [device.client.platform_version]
    machine = [device.platform, device.device_kind, processor(), os.environ.get("XLA_FLAGS", "")]
    digest.update(repr(versions + machine).encode())
    return digest.digest()


@functools.cache
def _known_release() -> bool:
    # Asked before every call, and read from files.
    return flags_are_known()


def _folder() -> pathlib.Path | None:
    """Where programs are kept; None for nowhere."""
    config = jax.config
    if not config.jax_compilation_cache_dir or not config.jax_enable_compilation_cache:
        return None
    if os.environ.get(SWITCH) == "0":
        return None
    if (
        not _known_release()
        or config.jax_disable_jit
        or config.jax_debug_nans
        or config.jax_debug_infs
        or len(jax.local_devices()) > 1
    ):
        return None
    return _below(config.jax_compilation_cache_dir)


def programs_folder(cache: str) -> pathlib.Path | None:
    """The folder of programs below that of jax's cache, made if need be; None where it cannot be written, or is not on
    this machine.

    **Raises:** `NotPrivate` where others can change it.
    """
    if "://" in cache:
        return None
    try:
        return private_folder(pathlib.Path(cache).absolute() / FOLDER)
    except OSError:
        return None


@functools.cache
def _below(cache: str) -> pathlib.Path | None:
    """The same; None, with one warning, where others can change it."""
    try:
        return programs_folder(cache)
    except NotPrivate as refused:
        warnings.warn(f"{refused}: compiled programs are not kept there, nor taken from there.", stacklevel=2)
        return None


def keeps_programs() -> bool:
    """Whether programs are kept on disk as things are set now."""
    return _folder() is not None


class _Hits(threading.local):
    """How many programs jax's cache has given to a thread so far."""

    count = 0

    def listen(self, event: str, **_) -> None:
        self.count += event.endswith("/cache_hits")


_hits = _Hits()
jax.monitoring.register_event_listener(_hits.listen)


class _KeptOut:
    """While any thread is inside, jax's own cache takes no new programs."""

    name = "jax_persistent_cache_min_compile_time_secs"

    def __init__(self):
        self._lock = threading.Lock()
        self._inside = 0

    def __enter__(self):
        with self._lock:
            if self._inside == 0:
                self._before = getattr(jax.config, self.name)
                jax.config.update(self.name, float("inf"))
            self._inside += 1

    def __exit__(self, *_):
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                jax.config.update(self.name, self._before)


_kept_out = _KeptOut()


def _compiled(lowered) -> tuple[jax.stages.Compiled, bool]:
    """The compiled program, and whether it was compiled here.

    What jax's cache has read can not be written again: the copy lacks its functions (seen with jaxlib 0.10.1). So these
    programs are kept out of that cache.
    """
    with _kept_out:
        before = _hits.count
        program = lowered.compile()
        return program, _hits.count == before


def _settings() -> tuple:
    config = jax.config
    return config.jax_enable_x64, config.jax_default_matmul_precision, config.jax_numpy_dtype_promotion


class _Known(NamedTuple):
    """A compiled program of flat arguments and results, and the form of what it returns."""

    program: jax.stages.Compiled
    form: jax.tree_util.PyTreeDef


_UNKNOWN = object()


def _is_traced() -> bool:
    """Whether what is computed now becomes part of a larger program."""
    return isinstance(jax.numpy.add(0.0, 0.0), jax.core.Tracer)


class StoredProgram:
    """A function as `equinox.filter_jit` compiles it, its programs kept on disk.

    **Arguments:** `function`; `level`: how far the compiler goes on a CPU, 0 to 3; None for what `XLA_FLAGS` says.
    """

    def __init__(self, function: Callable, level: int | None = None):
        functools.update_wrapper(self, function)
        self._function = function
        self._level = level
        self._ready: dict[tuple, _Known | None] = {}
        self._lock, self._turns = threading.Lock(), {}
        _everyone.append(self)

    @functools.cached_property
    def _options(self) -> dict[str, int]:
        # Which backend there is may not be asked before the user has had the chance to choose.
        if self._level is None or jax.default_backend() != "cpu":
            return {}
        return {"xla_backend_optimization_level": self._level}

    @functools.cached_property
    def _within(self) -> Callable:
        """For use inside of what another trace compiles, which takes no options of its own."""
        return eqx.filter_jit(self._function)

    @functools.cached_property
    def _alone(self) -> Callable:
        return eqx.filter_jit(self._function, **self._extra)

    def _plain(self, *args, **kwargs):
        way = self._within if self._options and _is_traced() else self._alone
        return way(*args, **kwargs)

    @property
    def _extra(self) -> dict:
        return {"compiler_options": self._options} if self._options else {}

    def __call__(self, *args, **kwargs):
        leaves, tree = jax.tree_util.tree_flatten((args, kwargs))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        if any(isinstance(leaf, jax.core.Tracer) for leaf in arrays):
            return self._within(*args, **kwargs)
        folder = _folder()
        static = tuple(None if eqx.is_array(leaf) else (type(leaf), leaf) for leaf in leaves)
        shapes = tuple((x.shape, x.dtype, getattr(x, "weak_type", False)) for x in arrays)
        key = tree, static, shapes, folder, _settings()
        try:
            known = self._ready.get(key, _UNKNOWN)
        except TypeError:
            return self._plain(*args, **kwargs)
        new = known is _UNKNOWN
        if new:
            # One thread prepares it, others that want it wait.
            with self._turn(key):
                known = self._ready.get(key, _UNKNOWN)
                if known is _UNKNOWN:
                    known = folder and self._prepared(folder, leaves, arrays, tree, shapes)
                    found = None if known else self._plain(*args, **kwargs)
                    self._ready[key] = known
                    if known is None:
                        return found
        if known is None:
            return self._plain(*args, **kwargs)
        try:
            found = known.program(*arrays)
            # Once, to see that what was read runs here.
            found = jax.block_until_ready(found) if new else found
        except jax.errors.JaxRuntimeError:
            self._ready[key] = None
            return self._plain(*args, **kwargs)
        return jax.tree_util.tree_unflatten(known.form, found)

    def _turn(self, key) -> threading.Lock:
        with self._lock:
            return self._turns.setdefault(key, threading.Lock())

    def _prepared(self, folder, leaves, arrays, tree, shapes) -> "_Known | None":
        """The program for such arguments: from disk, or compiled and kept there; None where it can not be kept."""
        try:
            if not self._function.__qualname__.isidentifier():
                return None
            frame = jax.tree_util.tree_unflatten(tree, [_Array() if eqx.is_array(x) else x for x in leaves])
            name = f"{self._function.__module__}.{self._function.__qualname__}"
            named = tuple((shape, str(dtype), bool(weak)) for shape, dtype, weak in shapes)
            wanted = _bytes_of((name, sorted(self._options.items()), named, _settings(), frame))
            path = folder / hashlib.sha256(_surroundings() + wanted).hexdigest()
        except Exception:
            return None
        _wake_lapack()
        known = _ahead(path)
        if known is not None:
            return known
        forms = []

        def flat(*arrays):
            remaining = iter(arrays)
            filled = [next(remaining) if eqx.is_array(leaf) else leaf for leaf in leaves]
            args, kwargs = jax.tree_util.tree_unflatten(tree, filled)
            found, form = jax.tree_util.tree_flatten(self._function(*args, **kwargs))
            forms.append(form)
            return found

        flat.__name__ = f"stored_{self._function.__name__}"
        program, fresh = _compiled(jax.jit(flat, **self._extra).lower(*arrays))
        known = _Known(program, forms[0])
        if fresh:
            _save(path, known)
        return known


def stored(function: Callable | None = None, *, level: int | None = None):
    """Decorator in place of `equinox.filter_jit` that keeps the compiled programs below jax's compilation cache.

    **Arguments:** `level`: how far the compiler goes, as in `StoredProgram`. `ONCE` for what runs so seldom that to
    compile it takes longer than all its runs.
    """
    if function is None:
        return lambda f: StoredProgram(f, level)
    return StoredProgram(function, level)


def forget() -> None:
    """Drop the programs that this process has loaded."""
    for program in _everyone:
        program._ready.clear()


@functools.cache
def _wake_lapack() -> None:
    """Have jaxlib look up the functions of LAPACK, which it does when a program that calls one is lowered."""
    jax.jit(jax.numpy.linalg.cholesky).lower(jax.numpy.eye(1))


def _load(path: pathlib.Path) -> _Known | None:
    """The program that `_save` wrote; None where there is none that can be read."""
    content = read_kept(path)
    if content is None:
        return None
    try:
        head, _, payload = content.partition(b"\n")
        said = json.loads(head)
        form = form_of(said["form"])
        in_tree = jax.tree_util.tree_structure(((0,) * said["inputs"], {}))
        out_tree = jax.tree_util.tree_structure([0] * form.num_leaves)
        return _Known(serialize_executable.deserialize_and_load(payload, in_tree, out_tree), form)
    except Exception:
        return None


_ahead = ReadAhead(_load)


def _save(path: pathlib.Path, known: _Known) -> None:
    """Write a program, whole or not at all; where that fails, the next process compiles it again."""
    try:
        payload, in_tree, _ = serialize_executable.serialize(known.program)
        head = json.dumps({"inputs": in_tree.num_leaves, "form": form_text(known.form)}).encode()
    except Exception:
        return
    write_kept(path, head + b"\n" + payload)
