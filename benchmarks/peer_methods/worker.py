"""One method in a process of its own: data in by NPZ, results out by JSON, one line each.

    python worker.py MODULE METHOD

Says first whether the method is there and which version; then takes the path of an NPZ file (u, y, h) a line on
standard input and answers with M, D, K and the seconds from arrays to matrices, or with what went wrong.
"""

import importlib
import json
import os
import sys
import time
import traceback


def main(module, method):
    # What a package prints must not fall between the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def answer(**content):
        answers.write(json.dumps(content) + "\n")
        answers.flush()

    try:
        home = importlib.import_module(module)
        call = home.METHODS[method]
    except Exception as error:  # noqa: BLE001 - whatever keeps a peer from running is its row in the table
        answer(error=f"{type(error).__name__}: {error}")
        return
    answer(version=home.VERSION)
    import numpy as np

    for line in sys.stdin:
        with np.load(line.strip()) as file:
            u, y, h = file["u"], file["y"], float(file["h"])
        try:
            began = time.perf_counter()
            matrices, note = call(u, y, h)
            matrices = [np.asarray(X).tolist() for X in matrices]
            answer(seconds=time.perf_counter() - began, matrices=matrices, note=note)
        except Exception as error:  # noqa: BLE001
            traceback.print_exc()
            answer(error=f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main(*sys.argv[1:])
