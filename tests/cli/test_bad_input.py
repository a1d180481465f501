"""Wrong arguments and wrong files, one row each: one line that names the argument, and nothing is written."""

import json
import os
import shlex

import numpy as np
import pytest
from independent import REFERENCE, REFERENCE_TIME, random_steps, simulate

from jaxgray.cli import main

GOOD = {
    "mass": [[2.0, 0.0], [0.0, 1.0]],
    "damping": [[3.0, 0.0], [0.0, 1.0]],
    "stiffness": [[100.0, -5.0], [-5.0, 90.0]],
}
FRICTION = {"effect": "end_stop", "location": "y1", "parameters": {"ks": 1e4, "gap": 0.01, "ds": 1.0}}

RECORD = "rec.csv --inputs u1,u2 --outputs y1,y2"
OUTPUTS = "--json out.json --report out.html --figures drawn"

READING = [
    ("none.csv --inputs u1 --outputs y1", "none.csv does not exist"),
    (". --inputs u1 --outputs y1", "is a folder"),
    ("pipe.csv --inputs u1 --outputs y1", "pipe.csv is no regular file"),
    ("empty.csv --inputs u1 --outputs y1", "empty.csv is empty"),
    ("header.csv --inputs u1 --outputs y1", "header.csv has 0 row(s)"),
    ("ragged.csv --inputs u1 --outputs y1", "ragged.csv has 2 cells at line 3"),
    ("text.csv --inputs u1 --outputs y1", "holds the text 'broken' at line 4"),
    ("infinite.csv --inputs u1 --outputs y1", "'y1' of infinite.csv is infinite at line 3"),
    ("backward.csv --inputs u1 --outputs y1", "time does not increase at line 4"),
    ("noise.npz --inputs u1 --outputs y1", "noise.npz is no npz archive"),
    ("noise.npy --inputs u1 --outputs y1", "noise.npy is no npy array"),
    ("noise.mat --inputs u1 --outputs y1", "noise.mat is no MATLAB file"),
    ("noise.h5 --inputs u1 --outputs y1", "noise.h5 is no HDF5 file"),
    ("noise.parquet --inputs u1 --outputs y1", "noise.parquet is no Parquet file"),
    ("noise.uff --inputs u1 --outputs y1", "noise.uff is no universal file"),
    ("noise.csv --inputs u1 --outputs y1", "noise.csv is not text"),
    ("noise.xls --inputs u1 --outputs y1", "noise.xls has an unknown ending"),
    ("rec.csv --inputs u9 --outputs y1", "inputs: rec.csv has no column 'u9'"),
    ("rec.csv --inputs u1 --outputs y9", "outputs: rec.csv has no column 'y9'"),
    ("rec.csv --inputs u1,u1 --outputs y1", "column 'u1' is twice in inputs"),
    ("rec.csv --inputs u1 --outputs u1", "column 'u1' is in inputs and in outputs"),
    ("rec.csv --inputs time --outputs y1 --time time", "column 'time' is in inputs and in time"),
    ("rec.csv --inputs , --outputs y1", "--inputs is empty"),
    ("rec.csv --inputs u1 --outputs ''", "--outputs is empty"),
    ("rec.csv --inputs u1", "--outputs"),
    ("rec.csv --outputs y1", "--inputs"),
    ("--inputs u1 --outputs y1", "FILE"),
    (f"{RECORD} rec.csv", "rec.csv"),
    (f"{RECORD} --time clock", "time: rec.csv has no column 'clock'"),
    (f"{RECORD} --sampling-time 0", "sampling_time is 0.0"),
    (f"{RECORD} --sampling-time nan", "sampling_time is nan"),
    (f"{RECORD} --sampling-time -1", "sampling_time is -1.0"),
    (f"{RECORD} --sampling-time soon", "--sampling-time"),
    (f"{RECORD} --time time --sampling-time 0.7", "sampling_time is 0.7 s and the time column says"),
    (f"{RECORD} --scheduling p", "scheduling: rec.csv has no column 'p'"),
    (f"{RECORD} --delimiter ;;", "delimiter is ';;'"),
    (f"{RECORD} --decimal x", "decimal is 'x'"),
    (f"{RECORD} --decimal , --delimiter ,", "decimal and delimiter are both ','"),
    (f"{RECORD} --input-units N", "input_units has 1 entries"),
    (f"{RECORD} --output-units m,m,m", "output_units has 3 entries"),
    (f"{RECORD} --hold first", "hold is 'first'"),
    (f"{RECORD} --measured speed", "measured is"),
    (f"{RECORD} --measured velocity,velocity,velocity", "for each of the 2 outputs"),
    (f"{RECORD} --frobnicate", "--frobnicate"),
    (f"{RECORD} --hold", "--hold"),
]

FITTING = [
    (f"{RECORD} --validation none.csv", "none.csv does not exist"),
    (f"{RECORD} --validation pipe.csv", "pipe.csv is no regular file"),
    (f"{RECORD} --holdout 0", "--holdout=0"),
    (f"{RECORD} --holdout 1", "--holdout=1"),
    (f"{RECORD} --holdout nan", "--holdout=nan"),
    (f"{RECORD} --holdout much", "--holdout"),
    (f"{RECORD} --holdout 0.3 --validation rec.csv", "--validation and --holdout"),
    (f"{RECORD} --excitation wind", "wind"),
    (f"{RECORD} --input-map u1:y1", "u2"),
    (f"{RECORD} --input-map u1=y1,u2=y2", "input_map"),
    (f"{RECORD} --time-constant 0.1,slow", "--time-constant='0.1,slow'"),
    (f"{RECORD} --time-constant -1", "time_constants"),
    (f"{RECORD} --time-constant nan", "time_constants"),
    (f"{RECORD} --block-rows 2", "block_rows"),
    (f"{RECORD} --block-rows 1.5", "--block-rows='1.5'"),
    (f"{RECORD} --weight moes", "moesp"),
    (f"{RECORD} --map best", "exact"),
]

MODELS = [
    (f"{RECORD} --structure diagonal", "diagonal-mass"),
    (f"{RECORD} --structure y1-y9", "y9"),
    (f"{RECORD} --fix stiffness=3", "stiffness=3"),
    (f"{RECORD} --fix mass[0,5]=1", "mass[0,5]"),
    (f"{RECORD} --fix mass[0,0]=nan", "mass[0,0]"),
    (f"{RECORD} --noise loud", "innovations"),
    (f"{RECORD} --hidden -1", "--hidden='-1'"),
    (f"{RECORD} --hidden 1.5", "--hidden='1.5'"),
    (f"{RECORD} --hidden ''", "--hidden=''"),
    (f"{RECORD} --hidden y1", "y1"),
]

PLACES = [
    (f"identify {RECORD} --json no/out.json", "the folder no is not there"),
    (f"identify {RECORD} --json .", "is a folder"),
    (f"identify {RECORD} --json pipe.csv", "pipe.csv is no regular file"),
    (f"identify {RECORD} --report no/out.html", "the folder no is not there"),
    (f"identify {RECORD} --json one --report one", "one is asked for twice"),
    (f"identify {RECORD} --json rec.csv", "rec.csv is read by this command"),
    (f"identify {RECORD} --validation good.csv --report ./good.csv", "good.csv is read by this command"),
    (f"identify {RECORD} --figures rec.csv", "rec.csv is no folder"),
    (f"sweep {RECORD} --json no/out.json", "the folder no is not there"),
    (f"sweep {RECORD} --spacing even", "spacing"),
    (f"diagnose {RECORD} --experiment no/next.csv", "the folder no is not there"),
    (f"diagnose {RECORD} --model good.json --report good.json", "good.json is read by this command"),
    ("effects --json no/out.json", "the folder no is not there"),
    ("simulate good.json rec.csv --out no/run.csv", "the folder no is not there"),
    ("simulate good.json rec.csv --out rec.csv", "rec.csv is read by this command"),
    ("export good.json no/out.xml", "the folder no is not there"),
    ("export good.json good.json", "good.json is read by this command"),
    ("demo --out rec.csv", "rec.csv is no folder"),
    ("docs --out rec.csv", "rec.csv is a file"),
    ("fleet rec.csv --inputs u1 --outputs y1 --out rec.csv", "rec.csv"),
]

DIAGNOSING = [
    (f"{RECORD} --no-refine", "--no-refine"),
    (f"{RECORD} --max-effects -1", "--max-effects=-1"),
    (f"{RECORD} --max-effects few", "--max-effects"),
    (f"{RECORD} --budget 0", "--budget=0"),
    (f"{RECORD} --budget nan", "--budget=nan"),
    (f"{RECORD} --seed -1", "--seed=-1"),
    (f"{RECORD} --only friction", "--only"),
    (f"{RECORD} --only ,", "--only is empty"),
    (f"{RECORD} --exclude cubic", "--exclude"),
    (f"{RECORD} --model none.json", "none.json does not exist"),
    (f"{RECORD} --model pipe.json", "pipe.json is no regular file"),
    (f"{RECORD} --model deep.json", "deep.json: this is not JSON"),
    (f"{RECORD} --model lacks.json", "lacks.json"),
    (f"{RECORD} --model one.json", "the model has 1 coordinates, --outputs names 2"),
    (f"{RECORD} --model good.json --structure chain", "--structure"),
    (f"{RECORD} --simulator none.py:run", "--simulator=none.py:run"),
    (f"{RECORD} --simulator broken.py:run", "broken.py raised ZeroDivisionError"),
    (f"{RECORD} --simulator robot.py:walk", "robot.py has no function walk"),
    (f"{RECORD} --simulator robot.py:run --model good.json", "--simulator and --model"),
    (f"{RECORD} --simulator robot.py:run --parameters k", "--parameters: 'k'"),
    (f"{RECORD} --simulator robot.py:run --workers 0", "--workers=0"),
    (f"{RECORD} --parameters k=1", "--parameters"),
    (f"{RECORD} --mended out.xml", "--mended"),
    (f"{RECORD} --forces a", "--forces=a"),
    (f"{RECORD} --simulated y9,y2", "'y9'"),
    (f"{RECORD} --simulated ,", "--simulated is empty"),
]

OTHERS = [
    ("simulate none.json rec.csv", "none.json does not exist"),
    ("simulate text.csv rec.csv", "the ending '.csv' is not known"),
    ("simulate broken.json rec.csv", "broken.json: this is not JSON"),
    ("simulate list.json rec.csv", "list.json: the top is a list"),
    ("simulate nan.json rec.csv", "mass[0,0] is nan"),
    ("simulate skew.json rec.csv", "stiffness is not symmetric"),
    ("simulate negative.json rec.csv", "mass has the eigenvalue"),
    ("simulate huge.json rec.csv", "mass is not a matrix of numbers"),
    ("simulate good.json rec.csv --inputs u1", "has 2 inputs and 2 outputs, --inputs and --outputs name 1 and 2"),
    ("simulate good.json rec.csv --hold first", "hold is 'first'"),
    ("simulate good.json", "FILE"),
    ("export good.json out.m", "the ending '.m' is not known"),
    ("export good.json out.h", "sampling_time is missing"),
    ("export good.json out.h --sampling-time -1", "sampling_time is -1.0"),
    ("export good.json out.mat --hold first", "first"),
    ("export stop.json out.xml", "end_stop"),
    ("export good.json", "OUT"),
    ("demo --effect wind", "wind"),
    ("demo --seed -1", "seed"),
    ("fleet none*.csv --inputs u1 --outputs y1 --out new", "no file matches none*.csv"),
    ("fleet none.csv --inputs u1 --outputs y1 --out new", "none.csv is no file"),
    ("fleet rec.csv --inputs u1 --outputs y1 --out new --task guess", "guess"),
    ("fleet rec.csv --inputs u1 --outputs y1 --out new --workers 0", "workers"),
    ("fleet rec.csv --inputs , --outputs y1 --out new", "--inputs is empty"),
    ("fleet rec.csv --inputs u1 --outputs y1 --out new --validation rec.csv", "--validation"),
    ("fleet rec.csv --inputs u1 --outputs y1 --out new --workers 2 --scheduler tcp://x", "--workers and --scheduler"),
    ("fleet rec.csv --inputs u1 --outputs y1", "--out"),
    ("idendify rec.csv", "idendify"),
    ("--frobnicate", "--frobnicate"),
]

CASES = [(f"identify {OUTPUTS} {given}", text) for given, text in READING + FITTING + MODELS]
CASES += [(f"sweep --json out.json {given}", text) for given, text in FITTING]
CASES += [(f"diagnose {OUTPUTS} --experiment next.csv {given}", text) for given, text in DIAGNOSING]
CASES += PLACES + OTHERS


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with good files and bad ones."""
    folder = tmp_path_factory.mktemp("bad")
    u = random_steps(np.random.default_rng(3), 300, 2, REFERENCE_TIME, hold_times=(0.05, 0.2))
    y = simulate(*REFERENCE.values(), u, REFERENCE_TIME)
    t = REFERENCE_TIME * np.arange(len(u))
    rows = [",".join(map(repr, row)) for row in np.column_stack([t, u, y]).tolist()]
    texts = {"rec.csv": ["time [s],u1 [N],u2 [N],y1 [m],y2 [m]", *rows], "empty.csv": [], "header.csv": ["time,u1,y1"]}
    texts["good.csv"] = texts["rec.csv"]
    texts["ragged.csv"] = ["time,u1,y1", "0,1,2", "1,2", "2,3,4"]
    texts["text.csv"] = ["time,u1,y1", "0,1,2", "1,2,3", "2,3,broken"]
    texts["infinite.csv"] = ["time,u1,y1", "0,1,2", "1,2,inf", "2,3,4"]
    texts["backward.csv"] = ["time,u1,y1", "0,1,2", "1,2,3", "1,3,4"]
    texts["broken.json"], texts["broken.py"] = ["{"], ["1 / 0"]
    texts["robot.py"] = ["def run(u, w, numbers):", "    return u"]
    for name, lines in texts.items():
        (folder / name).write_text("\n".join(lines) + ("\n" if lines else ""))
    for name in ("npz", "npy", "mat", "h5", "parquet", "uff", "csv", "xls"):
        (folder / f"noise.{name}").write_bytes(b"\0\x01" + np.random.default_rng(1).bytes(900))
    os.mkfifo(folder / "pipe.csv")
    os.mkfifo(folder / "pipe.json")
    models = {
        "good": GOOD,
        "lacks": {"mass": [[1.0]]},
        "one": {name: [[1.0]] for name in GOOD},
        "list": [1, 2],
        "nan": GOOD | {"mass": [[float("nan"), 0.0], [0.0, 1.0]]},
        "skew": GOOD | {"stiffness": [[1.0, 2.0], [3.0, 4.0]]},
        "negative": GOOD | {"mass": [[1.0, 2.0], [2.0, 1.0]]},
        "huge": GOOD | {"mass": [[10**400, 0], [0, 1]]},
        "stop": GOOD | {"effects": [FRICTION]},
    }
    for name, model in models.items():
        (folder / f"{name}.json").write_text(json.dumps(model))
    (folder / "deep.json").write_text("[" * 100_000)
    return folder


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


@pytest.mark.parametrize("argv, text", CASES, ids=[argv for argv, _ in CASES])
def test_one_line_and_nothing_written(capsys, place, monkeypatch, argv, text):
    monkeypatch.chdir(place)
    before = contents(place)
    assert main(shlex.split(argv)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("error: ") and said.err.endswith("\n") and said.err.count("\n") == 1, said.err
    assert text in said.err and len(said.err) < 1000, said.err
    assert contents(place) == before


def test_the_table_is_long():
    assert len({argv for argv, _ in CASES}) == len(CASES) >= 60
