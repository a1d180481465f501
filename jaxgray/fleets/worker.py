"""What a worker process does: it reads files, computes, keeps the results in the store, and returns their keys."""

import multiprocessing
import os
import signal
import threading
import time
import warnings
from pathlib import Path

from .store import Store
from .tasks import Job, Options

SETTINGS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    "TF_CPP_MIN_LOG_LEVEL": "3",
}
"""Environment of a worker: one computing thread, and no share of a GPU's memory that another worker needs."""

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"
"""Flag of XLA by which products of matrices stay on the thread that asks for them."""

SURVEYED = 9
"""Files from which the sampling time of a fleet is taken, evenly over their list."""


def environment() -> dict[str, str]:
    """What must be set before a worker's JAX starts; what the user has set stays."""
    found = {name: os.environ.get(name, value) for name, value in SETTINGS.items()}
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_multi_thread_eigen" not in flags:
        flags = f"{flags} {ONE_THREAD}".strip()
    return found | {"XLA_FLAGS": flags}


def dask_setup(worker) -> None:
    """Leave Ctrl-C to the process that asked: a worker is told what to do by its scheduler."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def work(job: Job) -> list[str]:
    """Do a job, one result in the store for every file.

    What is wrong with a record goes into its result. What is wrong with the store ends the call. What is there already
    is not done again: a scheduler repeats calls whose answer died with a worker.

    **Returns:** keys of the results, all of which are in the store.

    **Raises:** `OSError` where the store cannot be written.
    """
    _prepare(job.programs)
    store = Store(job.folder)
    size = job.batch if job.options.together else 1
    for first in range(0, len(job.files), size):
        _some(job, store, job.files[first : first + size])
    return [key for _, key, _ in job.files]


def _some(job: Job, store: Store, files) -> None:
    """Results of as many files as are computed side by side."""
    waiting = []
    for path, key, own in files:
        if key in store:
            continue
        read = _read(path, job)
        if isinstance(read, dict):
            store.write(key, read)
        else:
            waiting.append((path, key, own, *read))
    if job.options.together and len(waiting) > 0:
        waiting = _together(job, store, waiting)
    for path, key, own, record, notes, means, begun in waiting:
        store.write(key, _alone(job, store, path, key, own, record, notes, means, begun))


def plan(job: Job) -> dict:
    """What holds for all records of a fleet: sampling time [s], and time constants and block rows of the start.

    The sampling time is that of most of some files; the start that which serves the longest of them best.
    """
    _prepare(job.programs)
    step = max(1, len(job.files) // SURVEYED)
    found = [_read(path, job) for path, _, _ in job.files[::step]]
    records = [one[0] for one in found if not isinstance(one, dict)]
    if not records:
        for path, _, _ in job.files:
            one = _read(path, job)
            if not isinstance(one, dict):
                records = [one[0]]
                break
        else:
            return {}
    times = [record.sampling_time for record in records]
    usual = max(times, key=lambda h: (sum(_same(h, other) for other in times), -times.index(h)))
    made = {"sampling_time": usual}
    if job.options.together:
        made |= _start_of([record for record in records if _same(record.sampling_time, usual)], job.options)
    return made


def _same(one: float, other: float) -> bool:
    from ..records.joining import SAMPLING_TIME_TOLERANCE

    return abs(one - other) <= SAMPLING_TIME_TOLERANCE * other


def _start_of(records, options: Options) -> dict:
    """Time constants and block rows for batches; nothing where no record has a start."""
    from ..identification.batch.many import choices
    from ..numerics.outcomes import ComputationError

    fitting = {name: options.fitting.get(name) for name in ("time_constants", "block_rows", "weight", "input_map")}
    try:
        taus, rows = choices(records, **fitting)
    except ComputationError:
        return {}
    return {"time_constants": taus.tolist(), "block_rows": list(rows)}


def _prepare(programs: str | None) -> None:
    """One thread, 64-bit floats, and compiled programs where all workers find them."""
    # A cluster of somebody else has not been told; a process of the user's own is left as it is.
    if multiprocessing.parent_process() is not None:
        os.environ.update(environment())
    import jax

    from ..numerics.programs.compilation_cache import keep_compiled
    from ..numerics.programs.kept_files import NotPrivate

    jax.config.update("jax_enable_x64", True)
    if programs is None:
        return
    try:
        keep_compiled(Path(programs).absolute())
    except NotPrivate as refused:
        warnings.warn(f"{refused}: what is compiled is not kept, and every worker compiles anew.", stacklevel=2)


def _read(path: str, job: Job):
    """The record of a file, what the reader noted, and means of further columns; a failure's result otherwise."""
    from ..records import read_record
    from ..records.joining import with_step

    begun = time.perf_counter()
    reading, columns = dict(job.options.reading), list(job.options.columns)
    inputs = list(reading.pop("inputs"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            table = read_record(path, inputs=inputs + [c for c in columns if c not in inputs], **reading)
            means = {name: float(table.u[:, table.input_names.index(name)].mean()) for name in columns}
            record = table.select(inputs=range(len(inputs)))
            usual = job.plan.get("sampling_time")
            other = usual is not None and not _same(record.sampling_time, usual)
            if other and record.has_own_times:
                record = with_step(record, usual)
            elif other:
                raise ValueError(
                    f"sampling time {record.sampling_time:.6g} s, and {usual:.6g} s in the fleet; resample the "
                    "record, or give those of one sampling time a fleet of their own."
                )
        except Exception as error:
            return _failure(path, job, error, begun)
    notes = [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
    return record, notes, means, begun


def _failure(path: str, job: Job, error: Exception, begun: float, columns: dict | None = None) -> dict:
    """The result of a record that cannot be used."""
    text = " ".join(str(error).split()) or "no reason given"
    run = {"seconds": time.perf_counter() - begun, "memory_mib": _memory()}
    return failed_result(path, job.options.task, type(error).__name__, text, columns) | {"run": run}


def failed_result(path: str, task: str, kind: str, reason: str, columns: dict | None = None) -> dict:
    """What the store keeps of a record that has no answer: the `kind` of its failure, and the `reason` in words."""
    return {
        "file": path,
        "task": task,
        "columns": columns or {},
        "failure": {"kind": kind, "reason": reason},
        "document": None,
        "page": False,
        "run": {},
    }


def _result(path: str, job: Job, begun: float, columns: dict) -> dict:
    run = {"seconds": time.perf_counter() - begun, "memory_mib": _memory()}
    return failed_result(path, job.options.task, "", "", columns) | {"failure": None, "run": run}


def _memory() -> float | None:
    """Largest memory [MiB] that this process has had, where the system tells."""
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _together(job: Job, store: Store, waiting: list) -> list:
    """Identify records of equal shape side by side; what is left is what the batch did not bring to a safe end."""
    from ..identification.setup.padding import padded_samples
    from .batch import identified

    if not {"time_constants", "block_rows"} <= set(job.plan):
        return waiting
    groups, left = {}, []
    for one in waiting:
        record = one[3]
        shape = padded_samples(record.samples), record.has_missing, record.output_units, record.input_units
        groups.setdefault(shape, []).append(one)
    for group in groups.values():
        for k in range(0, len(group), job.batch):
            part = group[k : k + job.batch]
            begun, busy = time.perf_counter(), time.process_time()
            documents = identified([one[3] for one in part], job.plan, job.options.fitting, job.batch)
            share = (time.perf_counter() - begun) / len(part)
            busy = (time.process_time() - busy) / len(part)
            for one, document in zip(part, documents):
                if document is None:
                    left.append(one)
                    continue
                path, key, _, _, notes, means, _ = one
                document["warnings"] = [*notes, *document["warnings"]]
                result = _result(path, job, time.perf_counter() - share, means) | {"document": document}
                result["run"]["processor_seconds"] = busy
                store.write(key, result | {"page": _page_of_document(job, store, key, path, document)})
    return left


def _alone(job: Job, store: Store, path, key, own, record, notes, means, begun) -> dict:
    """The result of one record by itself."""
    from ..report.documents.export import plain

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made, document = _computed(job.options, own, record, notes)
        document = plain(document)
    except Exception as error:
        return _failure(path, job, error, begun, means)
    page = False
    if job.pages and made is not None:
        from ..report.page.whole import page_of, rendered

        store.write_page(key, rendered(page_of(made, tuple(notes)), library_at="library.js"))
        page = True
    return _result(path, job, begun, means) | {"document": document, "page": page}


def _computed(options: Options, own: dict, record, notes: list[str]):
    """What a task makes of a record: the result that a page shows, and its document."""
    from ..report.documents.identification import identification_document, modes_of

    fitting = {name: value for name, value in options.fitting.items() if value is not None}
    if options.task == "score":
        from .drift.score import score

        return None, score(record, own, **fitting)
    if options.task == "diagnose":
        from ..diagnosis.diagnose import diagnose
        from ..report.documents.diagnosis import diagnosis_document

        result = diagnose(record, **fitting)
        covariance = None
        if result.extended is None and result.identification is not None:
            covariance = result.identification.covariance
        modes = modes_of((result.extended or result.baseline).model, covariance)
        return result, diagnosis_document(result, tuple(notes)) | {"modes": modes}
    from ..identification import identify

    held_out = fitting.pop("holdout", None)
    record, validation = record.split(held_out) if held_out else (record, None)
    result = identify(record, validation=validation, **fitting)
    return result, identification_document(result, tuple(notes))


def _page_of_document(job: Job, store: Store, key: str, path: str, document: dict) -> bool:
    if not job.pages:
        return False
    from ..report.page.whole import rendered
    from .batch import page_of_document

    store.write_page(key, rendered(page_of_document(document, path), library_at="library.js"))
    return True
