"""Many records, one answer each: what has been done is looked up, the rest is carried out, and all of it tabulated."""

import concurrent.futures
import dataclasses
import json
import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from ..numerics.progress import AbstractProgress, Silent
from ..numerics.whole_files import write_whole
from ..report.documents.export import write_json
from ..report.page.whole import library_script, rendered
from .drift.changes import FEWEST
from .drift.machines import Drift, drifts_of, machines_of
from .drift.score import WEAR
from .drift.series import Naming
from .drift.shown import drift_document, drift_section
from .page import population_page
from .runner import AbstractEngine, Lost, carry_out, engines, refuse
from .store import Store
from .tables import row_of, write_tables
from .tasks import TASKS, Job, Options, batches, content_hash, key_of, listed, names
from .worker import failed_result, plan, work

BATCH = 8
"""Records of one shape that a worker identifies side by side, and loses at most where it dies."""

BATCHES_A_CALL, CALLS_A_WORKER = 4, 8
"""Batches that a worker is handed at once, at most, so that it does not wait for the next; and calls that every worker
should have at least, so that all end at about the same time."""

LOOKED_AT = 200
"""Files of a large fleet that what holds for all records is decided from."""

HASHES = "hashes.json"
"""Hashes of the files' bytes by path, size and time of change, so that files that have not changed are not read."""


@dataclass(frozen=True)
class Fleet:
    """What a fleet came to.

    `folder`: where its results are; `files` and `keys` of the results, one a record; `outcomes`: how many records
    came out how, by verdict, "identified" or "failed"; `failures`: reason by file; `computed`: records that were
    computed in this call, the others had been before; `table`, `matrices`, `page`: files for all of them; `drifts`:
    what has changed in machines over time; `not_compared`: why that is not known of a machine.
    """

    folder: Path
    files: tuple[str, ...]
    keys: tuple[str, ...]
    outcomes: dict[str, int]
    failures: dict[str, str]
    computed: int
    table: Path
    matrices: Path | None
    page: Path
    drifts: tuple[Drift, ...] = ()
    not_compared: dict[str, str] = field(default_factory=dict)

    def result(self, file) -> dict:
        """The result of one file, as it is in the store.

        **Raises:** `ValueError` for a file that is not of the fleet.
        """
        if str(file) not in self.files:
            raise ValueError(f"file: {file} is not of this fleet; give one of its {len(self.files)} files.")
        return Store(self.folder).read(self.keys[self.files.index(str(file))])

    def __repr__(self) -> str:
        lines = [f"Fleet of {len(self.files)} records, {self.computed} computed in this call, in {self.folder}"]
        lines += [f"  {count:7d} {outcome}" for outcome, count in self.outcomes.items()]
        lines += [f"  {file}: {reason}" for file, reason in list(self.failures.items())[:10]]
        if len(self.failures) > 10:
            lines.append(f"  and {len(self.failures) - 10} failures more, in {self.table.name}")
        lines += [f"  {drift.sentence}" for drift in self.drifts]
        return "\n".join(lines)


def fleet(
    paths,
    *,
    inputs,
    outputs,
    out,
    task: str = "identify",
    client=None,
    scheduler: str | None = None,
    workers: int | None = None,
    reading: dict | None = None,
    fitting: dict | None = None,
    machine: str | None = None,
    covariates=(),
    when_column: str | None = None,
    wear=WEAR,
    pages: bool = True,
    programs=None,
    again: bool = False,
    progress: AbstractProgress | None = None,
) -> Fleet:
    """Identify or diagnose every record of a fleet, each by itself, on as many workers as there are.

    What is done is kept in a folder; a second call does the rest. The key of a result is the hash of the file's bytes,
    of the options and of the package's version, so that another option never finds an old result.

    Where no client is given, processes of this machine start by themselves; a script that calls this needs the usual
    `if __name__ == "__main__":`.

    **Arguments:**

    - `paths`: files and patterns, such as `"data/*.parquet"`.
    - `inputs`, `outputs`: names of columns, as for `read_record`.
    - `out`: the folder of the results, reached by all workers; made where it is not there.
    - `task`: "identify" (default) or "diagnose".
    - `client`: a `distributed.Client` or an executor of `concurrent.futures` whose processes are spawned; default
        workers of this machine.
    - `scheduler`: address of a Dask scheduler instead of a client; default none.
    - `workers`: processes to start where neither is given; default one a core.
    - `reading`: further keywords of `read_record`; default none.
    - `fitting`: keywords of `identify` or `diagnose` that can be written as JSON; default none.
    - `machine`: pattern of the file names that says which machine a record is of, and when it was made, such as
        `"{machine}_{when}.parquet"`; default none.
    - `covariates`: columns whose means are kept with each result, such as a temperature; default none.
    - `when_column`: a column whose mean says when, in place of the file name; default none.
    - `wear`: ids of effects that may begin or grow with a machine's age, looked for where `machine` is given; default
        friction, drag, play, stops, and springs that stiffen.
    - `pages`: write a page for every record (default).
    - `programs`: folder of compiled programs that workers share; default `programs` below `out`.
    - `again`: compute anew what has failed before; default off.
    - `progress`: told of every record; silent by default.

    **Returns:** a `Fleet`.

    **Raises:** `ValueError` for arguments that cannot serve; `OSError` where the store cannot be written any more;
    `Lost`, a `RuntimeError`, where the workers are gone. What had been done by then is kept.

    **Example:**

        >>> import concurrent.futures
        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> for name, stiffness in (("a", 80.0), ("b", 90.0)):
        ...     model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[stiffness]])
        ...     u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)[:, None]
        ...     np.savez(f"{name}.npz", F=u[:, 0], x=model.simulate(u, 0.01)[:, 0] + 1e-4 * rng.standard_normal(1000))
        >>> options = {"inputs": "F", "outputs": "x", "reading": {"sampling_time": 0.01}}
        >>> with concurrent.futures.ThreadPoolExecutor(1) as client:
        ...     found = jaxgray.fleet("*.npz", out="fleet", client=client, **options)
        >>> found.outcomes
        {'identified': 2}
        >>> round(found.result("b.npz")["document"]["model"]["stiffness"][0][0])
        90
    """
    if task not in TASKS:
        raise ValueError(f"task is {task!r}; give {' or '.join(TASKS)}.")
    progress = Silent() if progress is None else progress
    covariates = names("covariates", covariates) if covariates else ()
    columns = (*covariates, *(() if when_column is None else (when_column,)))
    options = _options(task, inputs, outputs, reading, fitting, columns)
    files = listed(paths)
    naming = Naming.of(machine, when_column, covariates)
    naming.check(files)
    store = Store(out)
    store.open()
    progress.stage("reading the files' bytes")
    contents, unread = _contents(files, store)
    keys = {file: key_of(content, options.digest()) for file, content in contents.items()}
    try:
        with engines(client, scheduler, workers) as engine:
            settings = Settings(str(store.folder / "programs" if programs is None else programs), pages, again)
            asked = [(str(file), keys[file], {}) for file in files if file in keys]
            computed = complete(store, options, asked, settings, engine, progress)
            rows = [row_of(str(file), store, keys.get(file), unread.get(file), naming) for file in files]
            drifts, alone = (), {}
            if naming.pattern is not None:
                looked_for = dataclasses.replace(
                    options,
                    task="score",
                    fitting={"effects": list(wear), "input_map": options.fitting.get("input_map")},
                )
                texts = {str(file): content for file, content in contents.items()}
                drifts, alone, _ = _drift(store, rows, looked_for, texts, naming, settings, engine, progress)
    finally:
        # Workers that were stopped may have left something half-written.
        store.tidy()
    progress.stage("tabulating")
    documents = ((keys.get(file), store.read(keys[file]) if file in keys else None) for file in files)
    table, matrices = write_tables(store.folder, rows, documents)
    page = store.folder / "index.html"
    sections = () if naming.pattern is None else (drift_section(drifts, alone),)
    write_whole(rendered(population_page(rows, options.task, sections)).encode(), page)
    if naming.pattern is not None:
        write_json(drift_document(drifts, alone), store.folder / "drift.json")
    if pages:
        write_whole(library_script().encode(), store.pages / "library.js")
    return Fleet(
        store.folder,
        tuple(str(file) for file in files),
        tuple(keys.get(file, "") for file in files),
        dict(Counter(row["outcome"] for row in rows).most_common()),
        {row["file"]: row["failure"] for row in rows if row["failure"]},
        computed,
        table,
        matrices,
        page,
        drifts,
        alone,
    )


def _drift(store: Store, rows, options: Options, contents: dict[str, str], naming: Naming, settings, engine, progress):
    """Changes of machines, why others were not compared, and how many records were scored in this call."""
    results = [store.read(row["key"]) if row["outcome"] != "failed" else None for row in rows]
    machines, alone = machines_of(rows, results, naming.covariates)
    digest, asked = options.digest(), []
    for machine in machines:
        for file, reference in zip(machine.files, machine.references):
            own = reference | {"noise": list(machine.noise)}
            asked.append((file, key_of(contents[file], digest, own), own))
    computed = complete(store, options, asked, settings, engine, progress) if asked else 0
    progress.stage("comparing machines over time")
    keys, kept, scores = {file: key for file, key, _ in asked}, [], []
    for machine in machines:
        found = [(store.read(keys[file]) or {}).get("document") for file in machine.files]
        seen = [k for k, document in enumerate(found) if document is not None]
        if len(seen) < FEWEST:
            alone[machine.name] = f"{len(seen)} records could be compared with a reference"
            continue
        kept.append(machine.only(seen))
        scores.append([found[k] for k in seen])
    return tuple(drifts_of(kept, scores)), alone, computed


@dataclass(frozen=True)
class Settings:
    """How records are computed: folder of compiled `programs`, whether `pages` are written, and failures redone."""

    programs: str
    pages: bool
    again: bool


def complete(store: Store, options: Options, files, settings: Settings, engine, progress: AbstractProgress) -> int:
    """See to it that every file has its result in the store.

    **Arguments:** `store`; `options`; `files`: path, key and own options of each; `settings`; `engine`: called for the
    workers, where there is anything to do; `progress`.

    **Returns:** how many were computed.

    **Raises:** as `fleet`.
    """
    done = store.keys()
    if settings.again:
        failed = [key for _, key, _ in files if key in done and (store.read(key) or {"failure": 1})["failure"]]
        done -= set(failed)
        for key in failed:
            store.remove(key)
    left = {key: (path, key, own) for path, key, own in files if key not in done}
    if not left:
        return 0
    job = Job(str(store.folder.resolve()), options, tuple(files), {}, settings.programs, settings.pages, BATCH)
    workers: AbstractEngine = engine()
    job = dataclasses.replace(job, plan=_planned(store, job, workers, progress))
    groups = batches(left.values(), BATCH * _batches_a_call(len(left), workers.workers) if options.together else 1)
    jobs = [dataclasses.replace(job, files=group) for group in groups]

    def split(one: Job) -> list:
        return [(dataclasses.replace(one, files=(file,)), 1) for file in one.files] if len(one.files) > 1 else []

    def arrived(one: Job, error) -> None:
        if error is not None:
            path, key, _ = one.files[0]
            store.write(key, failed_result(path, options.task, "Killed", str(error)))

    try:
        carry_out(
            workers, work, jobs, [len(group) for group in groups], arrived, progress, len(files) - len(left), split
        )
    except (Lost, KeyboardInterrupt, OSError) as error:
        kept = len(store.keys() & {key for _, key, _ in files})
        text = f"the results of {kept} of {len(files)} records are kept in {store.folder}; call again for the rest"
        if isinstance(error, OSError):
            raise OSError(error.errno, f"{error.strerror or error}; {text}", error.filename) from None
        raise type(error)(f"{error}; {text}." if str(error) else f"{text}.") from None
    return len(left)


def _batches_a_call(records: int, workers: int) -> int:
    return min(BATCHES_A_CALL, max(1, records // (BATCH * CALLS_A_WORKER * workers)))


def _planned(store: Store, job: Job, workers: AbstractEngine, progress: AbstractProgress) -> dict:
    """What holds for all records, decided once a store and kept there."""
    name = job.options.digest()[:32]
    known = store.read_plan(name)
    if known is not None:
        return known
    progress.stage("looking at some records first")
    made: list[dict] = []
    some = job.files[:: max(1, len(job.files) // LOOKED_AT)]
    asked = dataclasses.replace(job, files=tuple((path, key, {}) for path, key, _ in some))
    carry_out(workers, plan, [asked], [0], refuse, Silent(), found=made.append)
    # Where no record could be read, later ones may.
    if made[0]:
        store.write_plan(name, made[0])
    return made[0]


def _options(task, inputs, outputs, reading, fitting, columns) -> Options:
    """Options as plain values.

    **Raises:** `ValueError` for a keyword that cannot be written as JSON, or that `fleet` sets itself.
    """
    reading, fitting = dict(reading or {}), dict(fitting or {})
    for name, given, own in (("reading", reading, ("inputs", "outputs")), ("fitting", fitting, ("progress", "model"))):
        for keyword in own:
            if keyword in given:
                raise ValueError(
                    f"{name} has {keyword!r}; leave it out: it is given to fleet itself, or not for fleets."
                )
        try:
            json.dumps(given)
        except TypeError:
            raise ValueError(
                f"{name} is {given!r}; give texts, numbers and lists, which can be kept as JSON."
            ) from None
    return Options(
        task,
        reading | {"inputs": list(names("inputs", inputs)), "outputs": list(names("outputs", outputs))},
        fitting,
        tuple(columns),
    )


def _contents(files: list[Path], store: Store) -> tuple[dict[Path, str], dict[Path, str]]:
    """Hash of every file that can be read, and why the others cannot."""
    try:
        known = json.loads((store.folder / HASHES).read_text())
    except (OSError, ValueError, RecursionError):
        known = {}
    if not isinstance(known, dict) or not all(isinstance(one, list) and len(one) == 3 for one in known.values()):
        known = {}
    contents, unread, hashes = {}, {}, {}

    def hashed(file: Path):
        try:
            state = os.stat(file)
            before = known.get(str(file))
            if before is not None and before[:2] == [state.st_size, state.st_mtime_ns]:
                return before
            return [state.st_size, state.st_mtime_ns, content_hash(file)]
        except OSError as error:
            return f"{file.name} cannot be read: {error.strerror or error}"

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for file, found in zip(files, pool.map(hashed, files)):
            if isinstance(found, str):
                unread[file] = found
            else:
                hashes[str(file)], contents[file] = found, found[2]
    if hashes != known:
        write_whole(json.dumps(known | hashes).encode(), store.folder / HASHES)
    return contents, unread


def summary_document(result: Fleet) -> dict:
    """What a fleet came to, as the JSON schema `jaxgray/fleet/1`."""
    return {
        "schema": "jaxgray/fleet/1",
        "folder": result.folder,
        "records": len(result.files),
        "computed": result.computed,
        "outcomes": result.outcomes,
        "failures": result.failures,
        "drifts": drift_document(result.drifts, result.not_compared)["drifts"],
        "table": result.table,
        "matrices": result.matrices,
        "page": result.page,
        "warnings": [],
    }
