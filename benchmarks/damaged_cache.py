"""Damage to what the command keeps: flipped bits, truncations, entries under the names of others; and no place to keep.

    python benchmarks/damaged_cache.py [--damages 112] [--seed 0] [--tree CHECKOUT] [--json OUT]

`jaxgray identify` runs on a short record with a cache directory of its own, then again in a new process after every
damage to one of its entries, entry after entry. The text of the result must be the same to the last digit, the exit
code 0, the error stream the same, and the entry whole again. Beside these: all entries damaged at once, two processes
at once that begin without a cache, a disk that takes no file of more than 1000 bytes, no home, and a cache directory
that others may write to. `--tree`: the code of another checkout, which may know nothing of digests.
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

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

import independent  # noqa: E402

LIMIT = 120
"""Seconds that a run may take."""

SMALL_FILE = 1000
"""Bytes of the largest file on the disk that is full."""


def written_record(folder, seed):
    """A short record of one coordinate as a file."""
    rng = np.random.default_rng(seed)
    u = independent.random_steps(rng, 400, 1, 0.05)
    y = independent.simulate(np.eye(1), 0.4 * np.eye(1), 9.0 * np.eye(1), u, 0.05)
    y = y + 0.02 * y.std() * rng.standard_normal(y.shape)
    path = folder / "record.csv"
    np.savetxt(path, np.hstack([u, y]), delimiter=",", header="u1,y1", comments="")
    return path


class Command:
    """`jaxgray identify` in new processes; `tree`: the checkout whose code runs."""

    def __init__(self, record, tree):
        self._words = [sys.executable, "-m", "jaxgray", "identify", str(record), "--inputs", "u1", "--outputs", "y1"]
        self._words += ["--sampling-time", "0.05", "--time-constant", "0.2", "--block-rows", "4", "--json", "-"]
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "JAXGRAY_", "XDG_"))}
        self._settings = kept | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}

    def start(self, cache, *, before=None, **settings):
        """A process with this cache directory."""
        settings = self._settings | {"XDG_CACHE_HOME": str(cache)} | settings
        pipe = subprocess.PIPE
        return subprocess.Popen(self._words, env=settings, stdout=pipe, stderr=pipe, text=True, preexec_fn=before)

    def __call__(self, cache, **options):
        return ended(self.start(cache, **options))


def ended(process):
    """Exit code, result and error stream of a process."""
    try:
        out, said = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return "too long", "", ""
    return process.returncode, out, said


def entries(cache):
    """Files of the cache, what belongs to a run first: programs, their order, JAX's own."""
    return sorted(path for path in cache.rglob("*") if path.is_file())


def flipped(rng, whole, others):
    k = int(rng.integers(8 * len(whole)))
    damaged = bytearray(whole)
    damaged[k // 8] ^= 1 << k % 8
    return bytes(damaged)


def cut(rng, whole, others):
    return whole[: int(rng.integers(len(whole)))]


def zeroed(rng, whole, others):
    """A page that was never written."""
    k = int(rng.integers(len(whole)))
    return whole[:k] + bytes(len(whole[k : k + 4096])) + whole[k + 4096 :]


def exchanged(rng, whole, others):
    """Another entry in the place of this one."""
    return others[int(rng.integers(len(others)))].read_bytes()


DAMAGES = {"flipped bit": flipped, "truncation": cut, "zeroed page": zeroed, "another entry": exchanged}
MOSTLY = ("flipped bit", "truncation")
"""Damages that make up nine runs of ten."""


def damaged_runs(command, cache, sound, count, rng):
    """Every outcome by damage, and what went wrong."""
    found, wrong = collections.Counter(), []
    files = entries(cache)
    for k in range(count):
        kind = MOSTLY[k % 2] if k % 10 < 9 else list(DAMAGES)[2 + k // 10 % 2]
        path = files[k % len(files)]
        whole = path.read_bytes()
        path.write_bytes(DAMAGES[kind](rng, whole, [other for other in files if other != path]))
        damaged = path.read_bytes()
        code, out, said = command(cache)
        result = verdict((code, out, said), sound)
        if result == "same" and damaged != whole and path.read_bytes() == damaged:
            result = "not replaced"
        found[kind, result] += 1
        if result != "same":
            wrong.append({"run": k, "damage": kind, "entry": path.name, "code": code, "result": result, "said": said})
            print(f"   {k}: {kind} of {path.name}: {result}, exit code {code}, {said[-200:]!r}", flush=True)
            path.write_bytes(whole)
    return found, wrong, len(files)


def verdict(run, sound):
    code, out, said = run
    if code == "too long":
        return "too long"
    if code != 0:
        return "crash"
    if out != sound[1]:
        return "other digits"
    return "same" if said == sound[2] else "other words"


def others_at_once(command, folder, cache, sound, rng):
    """What else may be wrong with the place, by name."""
    found = {}
    for path in entries(cache):
        whole = path.read_bytes()
        path.write_bytes(flipped(rng, whole, ()) if rng.random() < 0.5 else cut(rng, whole, ()))
    found["all entries damaged"] = verdict(command(cache), sound)
    pair = [command.start(folder / "empty") for _ in range(2)]
    found["two processes at once"] = ", ".join(verdict(ended(process), sound) for process in pair)
    found["after them"] = verdict(command(folder / "empty"), sound)

    def full():
        resource.setrlimit(resource.RLIMIT_FSIZE, (SMALL_FILE, SMALL_FILE))

    found["full disk"] = verdict(command(folder / "full", before=full), sound)
    found["after it"] = verdict(command(folder / "full"), sound)
    found["no home"] = verdict(command("", HOME="/proc/none"), sound)
    open_to_all = folder / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    run = command(open_to_all / "cache")
    warned = run[2].count("warning: others may write") == 1 and not (open_to_all / "cache").exists()
    found["folder open to all"] = verdict((*run[:2], sound[2]), sound) + (", one warning" if warned else ", kept there")
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--damages", type=int, default=112)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tree", default=HERE.parent, help="checkout whose code runs")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        command, cache = Command(written_record(folder, arguments.seed), arguments.tree), folder / "cache"
        runs = [command(cache) for _ in range(3)]
        if any(run[0] != 0 for run in runs):
            sys.exit(f"a run without damage failed: {runs}")
        sound = runs[-1]
        print(f"without damage: {', '.join(verdict(run, sound) for run in runs)}", flush=True)
        found, wrong, files = damaged_runs(command, cache, sound, arguments.damages, rng)
        for (kind, result), count in sorted(found.items()):
            print(f"{kind}: {count} of {arguments.damages} runs {result}")
        rest = others_at_once(command, folder, cache, sound, rng)
        for kind, result in rest.items():
            print(f"{kind}: {result}")
    good = sum(count for (_, result), count in found.items() if result == "same")
    print(f"{files} entries; {good} of {arguments.damages} damages without a trace")
    if arguments.json:
        counts = [{"damage": kind, "result": result, "runs": n} for (kind, result), n in sorted(found.items())]
        document = {"seed": arguments.seed, "entries": files, "damages": counts, "wrong": wrong, "other": rest}
        pathlib.Path(arguments.json).write_text(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
