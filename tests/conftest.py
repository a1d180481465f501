"""Set-up that every test needs: 64-bit floats, compilations shared by all workers."""

import contextlib
import gc
import os
import pathlib
import tempfile

# The threads of BLAS and of jax would take the few cores from each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Cached binaries are announced at length on the terminal otherwise.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# In the environment, so that commands and notebooks that tests start share it too.
cache = pathlib.Path(tempfile.gettempdir()) / f"jaxgray-tests-{os.getuid()}"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
# What one worker has traced and lowered the other need not, nor a command that a test starts.
os.environ.setdefault("JAXGRAY_PROGRAMS", "1")

import jax  # noqa: E402

# Sets what the backend reads when it starts, for the processes that tests start too.
import jaxgray  # noqa: E402, F401
from jaxgray.numerics.programs.backend import flags_are_known  # noqa: E402

# In one piece and without LLVM's optimisation, compiling takes half of its time; what users get runs faster.
SOONER = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
flags = os.environ.get("XLA_FLAGS", "")
if flags_are_known() and (not flags or flags.startswith("-")):
    os.environ["XLA_FLAGS"] = f"{flags} {SOONER}".strip()

jax.config.update("jax_enable_x64", True)
# Tracing makes objects by the hundred thousand, none of them garbage yet.
gc.set_threshold(50_000, 20, 20)

import pytest  # noqa: E402
from documents import WRITTEN  # noqa: E402
from shaking import shake_if_asked  # noqa: E402

from jaxgray.diagnosis.model import compile_ahead  # noqa: E402
from jaxgray.identification.setup import padding  # noqa: E402
from jaxgray.numerics.programs.stored_programs import FOLDER  # noqa: E402
from jaxgray.report.documents import export  # noqa: E402

shake_if_asked()
# Records of 1000 and 2000, and of 3000 and 4000 samples share what is compiled.
padding.LEAST_STEP = 4
# Both cores have work: what is compiled ahead, and then not needed, would take it from the other worker.
compile_ahead.cores = lambda: 1
# All that becomes JSON goes through it; the other modules import it later.
export.plain = WRITTEN.watch(export.plain)

# Compiling is most of the work, and what one worker has compiled the other reads: files that need the same programs
# do not start together, and the longest start first.
ORDER = (
    *("diagnosis/test_hidden.py", "identification/", "diagnosis/test_honest.py", "examples/", "diagnosis/"),
    *("test_docstrings.py", "manual/", "report/", "fleet/", "cli/"),
)


def pytest_sessionstart(session):
    """Whole programs that were made from older sources are never read again."""
    if hasattr(session.config, "workerinput"):
        return
    changed = max(path.stat().st_mtime for path in pathlib.Path(jaxgray.__file__).parent.rglob("*.py"))
    for path in pathlib.Path(os.environ["JAX_COMPILATION_CACHE_DIR"], FOLDER).glob("*"):
        # Another session on this machine may have removed it meanwhile.
        with contextlib.suppress(FileNotFoundError):
            if path.is_file() and path.stat().st_mtime < changed:
                path.unlink()


def pytest_collection_modifyitems(items):
    def turn(item):
        path = item.path.relative_to(pathlib.Path(__file__).parent).as_posix()
        return next((k for k, name in enumerate(ORDER) if path.startswith(name)), len(ORDER))

    items.sort(key=turn)


@pytest.fixture(autouse=True)
def documents_follow_their_schemas():
    """Whatever a test writes is valid."""
    WRITTEN.faults.clear()
    yield
    assert not WRITTEN.faults, "\n".join(WRITTEN.faults)


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["documents"] = dict(WRITTEN.valid)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    WRITTEN.valid.update(getattr(node, "workeroutput", {}).get("documents", {}))


def pytest_terminal_summary(terminalreporter):
    told = ", ".join(f"{name} {count}" for name, count in sorted(WRITTEN.valid.items()))
    if told:
        terminalreporter.write_line(f"valid documents: {told}")
