"""Smallest size of every effect that the demonstration would have shown, for the pages of the manual.

    python benchmarks/smallest_sizes.py [RESULT.json]

RESULT.json: what `jaxgray demo --effect none --out DIR` wrote as DIR/result.json; computed anew without it. Of the
places of an effect the first is taken. Writes jaxgray/manual/smallest_sizes.json.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

TARGET = pathlib.Path(__file__).parents[1] / "jaxgray" / "manual" / "smallest_sizes.json"


def main(argv):
    with tempfile.TemporaryDirectory() as folder:
        if not argv:
            subprocess.run([sys.executable, "-m", "jaxgray", "demo", "--effect", "none", "--out", folder], check=True)
        result = json.loads(pathlib.Path(argv[0] if argv else f"{folder}/result.json").read_text(encoding="utf-8"))
    effects = {}
    for one in sorted(result["not_found"], key=lambda one: one["location"]):
        # Of parameters that are a list, one an element, the largest.
        values = {name: np.max(np.abs(size["value"])) for name, size in one["min_detectable"].items()}
        sizes = {name: float(f"{value:.2g}") for name, value in values.items() if value > 0}
        effects.setdefault(one["effect"], {"location": one["location"], "sizes": sizes})
    text = json.dumps({"effects": effects}, indent=1, ensure_ascii=False, sort_keys=True)
    TARGET.write_text(text + "\n", encoding="utf-8")
    print(f"{len(effects)} effects")


if __name__ == "__main__":
    main(sys.argv[1:])
