"""Processes killed while they write, full disks and read-only folders: is every result whole, the old or the new one?

`commands`: whole commands in processes of their own, killed at any moment between start and end, or as soon as a file
is being written. `writers`: a process that has everything in memory and writes results over and over by the functions
that commands end with, killed after a random time, so that most kills meet a write. `disks`: the same functions on a
disk that becomes full (a small tmpfs where one can be mounted, a limit on the size of files), and in a folder that may
not be written.
"""

import argparse
import ctypes
import io
import itertools
import json
import os
import pathlib
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile

import numpy as np

from jaxgray.cli.arguments import Talk
from jaxgray.cli.finishing import finish
from jaxgray.fleets.store import Store
from jaxgray.numerics.whole_files import PART, write_whole

ROOT = pathlib.Path(__file__).resolve().parents[1]
SIGNALS = (signal.SIGKILL,) * 6 + (signal.SIGTERM, signal.SIGINT)
LONGEST_WAIT = 0.05
"""Seconds that a writer lives at most, some writes long."""
NOBODY = 65534
"""User without rights, for folders that even root could write."""
TMPFS_BYTES = 2**20


def record_file(path: pathlib.Path, samples: int = 1500, seed: int = 1) -> None:
    """A mass on a spring, driven by steps."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(samples // 10), 10)
    y, q, v, h = np.empty(samples), 0.0, 0.0, 0.01
    for k in range(samples):
        y[k] = q
        v += h * (u[k] - 0.8 * v - 40.0 * q)
        q += h * v
    rows = np.column_stack([h * np.arange(samples), u, y + 1e-4 * rng.standard_normal(samples)])
    np.savetxt(path, rows, delimiter=",", header="time,u,y", comments="", fmt="%.9g")


def whole(path: pathlib.Path) -> bool:
    """Whether a file is complete by its own format."""
    content = path.read_bytes()
    try:
        if path.suffix == ".json":
            return isinstance(json.loads(content), dict)
        if path.suffix == ".html":
            return content.rstrip().endswith(b"</html>")
        if path.suffix == ".png":
            return content[:4] == b"\x89PNG" and content[-8:-4] == b"IEND"
        if path.suffix == ".csv":
            lines = content.decode().splitlines()
            return content.endswith(b"\n") and len({line.count(",") for line in lines}) == 1 and len(lines) == 1501
        if path.suffix == ".npz":
            return zipfile.ZipFile(io.BytesIO(content)).testzip() is None
        return content.rstrip().endswith((b"</mujoco>", b"#endif"))
    except (ValueError, OSError, zipfile.BadZipFile):
        return False


def commands(count: int, draw: random.Random, folder: pathlib.Path) -> dict:
    """Whole commands, half killed at any moment, half a moment after a file is begun."""
    record_file(folder / "rec.csv")
    out = folder / "out"
    out.mkdir()
    channels = ["rec.csv", "--inputs", "u", "--outputs", "y"]
    drawn = ["--json", "out/a.json", "--report", "out/a.html", "--figures", "out"]
    rows = (
        ["identify", *channels, *drawn, "--quiet"],
        ["simulate", "out/a.json", "rec.csv", "--out", "out/run.csv", "--json", "out/fit.json", "--quiet"],
        ["export", "out/a.json", "out/model.xml", "--quiet"],
        ["export", "out/a.json", "out/model.npz", "--quiet"],
        ["effects", "--json", "out/effects.json"],
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder / "cache")}

    def start(row):
        line = [sys.executable, "-m", "jaxgray", *row]
        return subprocess.Popen(line, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    took = []
    for row in rows * 2:
        begun = time.monotonic()
        if start(row).wait() != 0:
            raise SystemExit(f"{' '.join(row)} fails by itself")
        took.append(time.monotonic() - begun)
    took = took[len(rows) :]
    before = {path: path.read_bytes() for path in out.iterdir()}
    found = {"kills": 0, "corrupt": 0, "lost": 0, "changed": 0, "over already": 0, "while writing": 0, "left beside": 0}
    for k in range(count):
        row = k % len(rows)
        process, begun = start(rows[row]), time.monotonic()
        if k % 2:
            time.sleep(draw.uniform(0.0, took[row]))
        else:
            while process.poll() is None and not list(out.glob(f"{PART}*")):
                time.sleep(0.0005)
            time.sleep(draw.choice((0.0, 0.0, 0.001, 0.01)))
        over = process.poll() is not None
        process.send_signal(draw.choice(SIGNALS))
        process.wait()
        found["over already" if over else "kills"] += 1
        left = list(out.glob(f"{PART}*"))
        found["while writing"] += bool(left)
        found["left beside"] = max(found["left beside"], len(left))
        for path, content in before.items():
            found["lost"] += not path.exists()
            if path.exists() and path.read_bytes() != content:
                found["changed"] += 1
                found["corrupt"] += not whole(path)
                before[path] = path.read_bytes()
    for row in rows:
        start(row).wait()
    return found | {
        "left after the next": len(list(out.glob(f"{PART}*"))),
        "seconds_a_command": [round(t, 1) for t in took],
    }


def contents(generation: int, size: int) -> dict[str, bytes]:
    """What a generation of results is, by name."""
    block = f"{generation:08d}".encode() * (size // 8)
    return {name: f"{name} {generation}\n".encode() + block for name in ("a.html", "a.png", "b.png")}


def document(generation: int, size: int) -> dict:
    return {"generation": generation, "numbers": [float(generation)] * (size // 16), "warnings": []}


def write_generation(folder: pathlib.Path, store: Store, generation: int, size: int) -> None:
    """All files of a generation, by the functions that commands end with."""
    files = {folder / name: content for name, content in contents(generation, size).items()}
    finish(document(generation, size), None, Talk(quiet=True), str(folder / "a.json"), files, [])
    write_whole(contents(generation, size)["a.html"], folder / "report.html")
    store.write("key", {"document": document(generation, size)})
    store.write_page("key", contents(generation, size)["a.html"].decode())


NAMES = ("a.html", "a.png", "b.png", "a.json", "report.html", "results/key.json", "pages/key.html")


def generation_of(folder: pathlib.Path, name: str, size: int) -> int | None:
    """Which generation a file is, None where it is not wholly one."""
    content = (folder / name).read_bytes()
    try:
        if name.endswith(".json"):
            found = json.loads(content)
            found = found.get("document", found)
            generation = found["generation"]
            return generation if found == document(generation, size) else None
        generation = int(content.split(b"\n")[0].split()[1])
        own = "a.html" if name.endswith("html") else name
        return generation if content == contents(generation, size)[own] else None
    except (ValueError, KeyError, IndexError):
        return None


def judged(folder: pathlib.Path, size: int, before: dict[str, int], found: dict) -> dict[str, int]:
    """Count what is lost, damaged or older than before; the generations that are there now."""
    now = {}
    for name in NAMES:
        if not (folder / name).exists():
            found["lost"] += 1
            continue
        generation = generation_of(folder, name, size)
        found["corrupt"] += generation is None
        found["older"] += generation is not None and generation < before.get(name, 0)
        now[name] = before.get(name, 0) if generation is None else generation
    return now


def fresh(**more) -> dict:
    return {"kills": 0, "corrupt": 0, "lost": 0, "older": 0} | more


def forked(action) -> int:
    """Run in a process of its own; its exit code, 0 where nothing was raised."""
    process = os.fork()
    if process:
        return process
    try:
        action()
        os._exit(0)
    except OSError as error:
        os._exit(error.errno or 1)
    except ValueError:
        os._exit(200)
    except KeyboardInterrupt:
        os._exit(130)
    except BaseException:
        os._exit(201)


def ended(process: int, wanted: int) -> None:
    """End a process by a signal, and where Python loses it, as it may while it starts, by one that cannot be lost."""
    os.kill(process, wanted)
    for _ in range(200):
        if os.waitpid(process, os.WNOHANG)[0]:
            return
        time.sleep(0.005)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)


def writers(count: int, draw: random.Random, folder: pathlib.Path) -> dict:
    """Writers that are killed while they write generation after generation."""
    found = fresh(**{"while writing": 0, "generations": 0, "most left beside": 0})
    for size in (2_000, 200_000):
        place = folder / str(size)
        store = Store(place)
        store.open()
        write_generation(place, store, 1, size)
        before = dict.fromkeys(NAMES, 1)
        for _ in range(count // 2):
            following = itertools.count(max(before.values()) + 1)

            def forever(following=following, place=place, store=store, size=size):
                for generation in following:
                    write_generation(place, store, generation, size)

            process = forked(forever)
            time.sleep(draw.uniform(0.0, LONGEST_WAIT))
            ended(process, draw.choice(SIGNALS))
            found["kills"] += 1
            left = sum(1 for _ in place.rglob(f"{PART}*"))
            found["while writing"] += bool(left)
            found["most left beside"] = max(found["most left beside"], left)
            first = max(before.values())
            before = judged(place, size, before, found)
            found["generations"] += max(before.values()) - first
        store.open()
        write_generation(place, store, max(before.values()) + 1, size)
        found["left after the next"] = sum(1 for _ in place.rglob(f"{PART}*"))
    return found


def mounted(folder: pathlib.Path) -> bool:
    """Whether a small disk could be mounted there; it goes with the process."""
    library = ctypes.CDLL(None, use_errno=True)
    new_mounts, private = 0x00020000, 0x40000 | 0x4000
    if library.unshare(new_mounts) or library.mount(b"none", b"/", None, private, None):
        return False
    options = f"size={TMPFS_BYTES}".encode()
    return library.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, options) == 0


def disks(count: int, draw: random.Random, folder: pathlib.Path) -> dict:
    """Writing on a disk with too little room, beyond a limit, and where it may not: what was there must stay."""
    results = {}
    small = folder / "small"
    small.mkdir()
    tmpfs = mounted(small)
    size = 100_000

    def tried(place: pathlib.Path, store: Store, before, found, action):
        process = forked(action)
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        found["kills"] += 1
        found["refused"] += code != 0
        found["untold"] += code not in (0, 200) and not 0 < code < 130
        found["left beside"] += sum(1 for _ in place.rglob(f"{PART}*"))
        return judged(place, size, before, found)

    for name in ("full disk", "limit of file size", "read-only folder"):
        if name == "full disk" and not tmpfs:
            results[name] = "no disk could be mounted"
            continue
        place = (small if name == "full disk" else folder) / name.replace(" ", "-")
        store = Store(place)
        store.open()
        write_generation(place, store, 1, size)
        before, found = dict.fromkeys(NAMES, 1), fresh(refused=0, untold=0, **{"left beside": 0})
        for _ in range(count):
            generation = max(before.values()) + 1

            def write(generation=generation, place=place, store=store):
                write_generation(place, store, generation, size)

            if name == "full disk":
                free = os.statvfs(place)
                filling = place / "filling"
                filling.write_bytes(bytes(max(0, free.f_bavail * free.f_frsize - draw.randrange(5 * size))))
                before = tried(place, store, before, found, write)
                filling.unlink()
            elif name == "limit of file size":
                limit = draw.randrange(1, 2 * size)

                def limited(limit=limit, write=write):
                    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
                    write()

                before = tried(place, store, before, found, limited)
            else:
                for part in (place, place / "results", place / "pages"):
                    part.chmod(0o555)

                def powerless(write=write):
                    os.setuid(NOBODY)
                    write()

                before = tried(place, store, before, found, powerless)
        results[name] = found
    return results


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", action="append", choices=("commands", "writers", "disks"), help="default all")
    parser.add_argument("--commands", type=int, default=40, help="whole commands that are killed")
    parser.add_argument("--count", type=int, default=1000, help="writers that are killed")
    parser.add_argument("--tries", type=int, default=100, help="writes on each bad disk")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=pathlib.Path)
    given = parser.parse_args()
    counts = {"commands": given.commands, "writers": given.count, "disks": given.tries}
    results = {}
    for name in given.part or counts:
        folder = pathlib.Path(tempfile.mkdtemp(prefix="kills-"))
        folder.chmod(0o755)
        begun = time.perf_counter()
        try:
            results[name] = {"commands": commands, "writers": writers, "disks": disks}[name](
                counts[name], random.Random(given.seed), folder
            )
        finally:
            # A folder that may not be written is removed by its owner all the same.
            shutil.rmtree(folder, ignore_errors=True)
        print(name, json.dumps(results[name]), f"{time.perf_counter() - begun:.0f} s", flush=True)
    if given.json:
        given.json.write_text(json.dumps({"seed": given.seed, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
