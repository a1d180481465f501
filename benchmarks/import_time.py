"""Start-up: what `import jaxgray` costs beside its dependencies, and how a first `jaxgray identify` splits.

    python benchmarks/import_time.py [--rounds 7] [--sites 25] [--json OUT]

Imports are timed inside fresh interpreters, in turn. `jaxgray identify` runs as a command on 20 000 samples of the
reference system (data from SciPy) with a compilation cache of its own: once cold, then with the cache warm. One more
warm run listens to jax and to Python's imports and says where the time goes: importing, tracing, lowering, loading of
compiled programs, and the rest (reading, computing, printing); and who asks for the programs.
"""

import argparse
import collections
import json
import os
import pathlib
import resource
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent

IMPORTS = {
    "import jax, equinox, optimistix": "import jax, equinox, optimistix",
    "import jaxgray": "import jaxgray",
    "import jaxgray; Record, identify": "import jaxgray; jaxgray.Record; jaxgray.identify",
    "all public names of jaxgray": "import jaxgray; [getattr(jaxgray, name) for name in jaxgray.__all__]",
}
REFERENCE = "import jax, equinox, optimistix"
IMPORT_BAR, COMMAND_BAR = 1.3, 6.0
TIMER = "import time; began = time.perf_counter(); {}; print(time.perf_counter() - began)"

KINDS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    "/jax/core/compile/backend_compile_duration": "loading",
}


def environment(**more):
    """The caller's, but for the compilation cache, which is the command's own choice here."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    return {**kept, "PYTHONPATH": str(ROOT), "TF_CPP_MIN_LOG_LEVEL": "3", **more}


def median(values):
    return sorted(values)[len(values) // 2]


def imports(rounds):
    times = collections.defaultdict(list)
    for k in range(rounds + 1):
        for name, statement in IMPORTS.items():
            done = subprocess.run(
                [sys.executable, "-c", TIMER.format(statement)],
                env=environment(),
                capture_output=True,
                text=True,
                check=True,
            )
            # The first round writes byte code and warms the disk.
            if k:
                times[name].append(float(done.stdout))
    result = {}
    print(f"{'imports in fresh processes, medians of ' + str(rounds):44s}{'s':>8s}{'ratio':>8s}")
    for name, values in times.items():
        ratio = median([a / b for a, b in zip(values, times[REFERENCE])])
        result[name] = {"seconds": median(values), "ratio": ratio, "all": values}
        print(f"  {name:42s}{median(values):8.2f}{ratio:8.2f}")
    print(f"  bar: `import jaxgray` at most {IMPORT_BAR} times `{REFERENCE}`", flush=True)
    return result


def write_record(path):
    sys.path.insert(0, str(ROOT / "tests"))
    import independent as data
    import numpy as np

    u, y, _ = data.reference_record(0)
    table = np.column_stack([data.REFERENCE_TIME * np.arange(len(u)), u, y])
    np.savetxt(path, table, delimiter=",", header="time,u1,u2,y1,y2", comments="", fmt="%.9g")


def arguments(path):
    return ["identify", str(path), "--inputs", "u1,u2", "--outputs", "y1,y2", "--json", str(path.with_suffix(".json"))]


def command(path, cache):
    """Seconds on the clock, and of all cores: the second is what other work on the machine changes less."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "jaxgray", *arguments(path)],
        env=environment(XDG_CACHE_HOME=str(cache)),
        check=True,
        stdout=subprocess.DEVNULL,
    )
    seconds = time.perf_counter() - began
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime


def first_identify(rounds, sites, cache):
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        write_record(folder / "record.csv")
        cold = command(folder / "record.csv", cache or folder)
        warm = [command(folder / "record.csv", cache or folder) for _ in range(max(rounds // 2, 1))]
        done = subprocess.run(
            [sys.executable, __file__, "--listen", str(folder / "record.csv")],
            env=environment(XDG_CACHE_HOME=str(cache or folder), OPENBLAS_NUM_THREADS="1"),
            capture_output=True,
            text=True,
            check=True,
        )
    split = json.loads(done.stdout.splitlines()[-1])
    first = "" if cache else f"cold {cold[0]:.1f} s, "
    seconds, busy = (median(values) for values in zip(*warm))
    print(f"\nfirst `jaxgray identify` in a new process, 20 000 samples: {first}cache warm {seconds:.2f} s")
    print(f"  bar: {COMMAND_BAR:g} s with the cache warm; processor time of the warm run {busy:.2f} s")
    print(f"  where a warm run of {split['total']:.2f} s goes (one run, listened to):")
    for kind, seconds in split["seconds"].items():
        print(f"    {kind:34s}{seconds:7.2f} s")
    print(f"    (the same call again in that process: {split['again']:.2f} s)")
    print(f"  {split['programs']} programs, of which {split['small']} are single operations outside any jit")
    print(f"  {'asked for at':58s}{'programs':>9s}{'s':>7s}")
    for place, count, seconds, names in split["sites"][:sites]:
        print(f"    {place:56s}{count:9d}{seconds:7.2f}  {names}")
    return {"cold": None if cache else cold, "warm": warm, "split": split}


class Listener:
    """Spans of importing, tracing, lowering and loading in this process, innermost first counted once."""

    def __init__(self):
        self.spans = []
        self.programs = []
        self.depth = 0

    def import_hooks(self):
        import builtins
        import importlib

        def timed(load):
            def call(*given, **named):
                self.depth += 1
                began = time.perf_counter()
                try:
                    return load(*given, **named)
                finally:
                    self.depth -= 1
                    ended = time.perf_counter()
                    # What is loaded already is asked for again thousands of times.
                    if self.depth == 0 and ended - began > 1e-4:
                        self.spans.append(("importing", began, ended))

            return call

        builtins.__import__ = timed(builtins.__import__)
        importlib.import_module = timed(importlib.import_module)

    def compile_hooks(self):
        import jax

        jax.monitoring.register_event_duration_secs_listener(self.heard)

    def heard(self, event, duration, fun_name="", **_):
        kind = KINDS.get(event)
        if kind is None:
            return
        now = time.perf_counter()
        self.spans.append((kind, now - duration, now))
        if kind == "loading":
            self.programs.append((fun_name, *self.place(), now))

    def place(self):
        """The innermost line of jaxgray, and whether it calls a compiled function of jaxgray's own."""
        frame = sys._getframe(2)
        while frame is not None:
            file = frame.f_code.co_filename
            if f"{os.sep}jaxgray{os.sep}" in file and "benchmarks" not in file:
                return (f"{file.rpartition(f'jaxgray{os.sep}')[2]}:{frame.f_lineno} {frame.f_code.co_name}",)
            frame = frame.f_back
        return ("elsewhere",)

    def own_time(self):
        """Seconds of every kind, each moment given to the innermost span that covers it; spans nest."""
        total, around = collections.Counter(), []
        for kind, began, ended in sorted(self.spans, key=lambda span: (span[1], -span[2])):
            while around and around[-1][1] <= began:
                around.pop()
            total[kind] += ended - began
            if around:
                total[around[-1][0]] -= min(ended, around[-1][1]) - began
            around.append((kind, ended))
        return total


def listen(path):
    """One warm run in this process; prints its split as a line of JSON."""
    began = time.perf_counter()
    listener = Listener()
    listener.import_hooks()
    import jax

    from jaxgray.cli import main

    listener.compile_hooks()
    own = own_names()
    shown, sys.stdout = sys.stdout, open(os.devnull, "w", encoding="utf-8")
    code = main(arguments(path))
    total = time.perf_counter() - began
    spans = listener.own_time()
    programs = list(listener.programs)
    began = time.perf_counter()
    main(arguments(path))
    again = time.perf_counter() - began
    sys.stdout = shown
    if code:
        raise SystemExit(f"jaxgray identify ended with {code}")
    spans["the rest: reading, computing, printing"] = total - sum(spans.values())
    loads = {ended: ended - start for kind, start, ended in listener.spans if kind == "loading"}
    sites = collections.defaultdict(list)
    for name, place, now in programs:
        sites[place].append((name, loads[now]))
    rows = [
        (place, len(found), sum(s for _, s in found), ", ".join(sorted({n for n, _ in found})[:4]))
        for place, found in sites.items()
    ]
    print(
        json.dumps(
            {
                "jax": jax.__version__,
                "total": total,
                "again": again,
                "seconds": dict(spans),
                "programs": len(programs),
                "small": sum(name.removeprefix("jit(").rstrip(")") not in own for name, _, _ in programs),
                "sites": sorted(rows, key=lambda row: (-row[1], -row[2])),
            }
        )
    )


def own_names():
    """Names of the functions that jaxgray defines: what is compiled under another name is a single operation."""
    import ast

    names = set()
    for file in (ROOT / "jaxgray").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                names.add(node.name)
    return names


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--sites", type=int, default=25, help="how many callers to print")
    parser.add_argument(
        "--cache", type=pathlib.Path, help="user cache directory to take as it is; no cold run is timed"
    )
    parser.add_argument("--listen", type=pathlib.Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    if options.listen:
        listen(options.listen)
        return
    result = {"cores": os.cpu_count(), "imports": imports(options.rounds)}
    result["identify"] = first_identify(options.rounds, options.sites, options.cache)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
