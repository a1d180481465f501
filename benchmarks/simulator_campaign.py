"""What the benchmarks of a user's simulator share: the laws that were found, and a campaign with and without a hidden
effect, stored record by record."""

import argparse
import json
import pathlib
import warnings


def laws_of(found):
    """The laws among the findings of a diagnosis, without numbers that are off."""
    return [f for f in found.findings if f.stage == "model" and f.effect not in ("parameter_error", "unexplained")]


def campaign(name, judged, effects, records, without):
    """Judge records with an effect each, in turn, then records without, and print how many were right.

    **Arguments:** `name` that is printed; `judged`: from a seed and an effect (None for none) to a row, of which
    "right" counts; `effects`; `records`, `without`: how many where the command line does not say.

    **Returns:** the rows.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--records", type=int, default=records)
    parser.add_argument("--without", type=int, default=without)
    parser.add_argument("--json")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    cases = [(given.first + k, effects[(given.first + k) % len(effects)]) for k in range(given.records)]
    cases += [(given.first + given.records + k, None) for k in range(given.without)]
    for seed, effect in cases:
        rows.append(judged(seed, effect))
        print(rows[-1], flush=True)
        if given.json:
            pathlib.Path(given.json).write_text(json.dumps(rows, indent=1, default=float))
    hidden, plain = ([r for r in rows if (r["effect"] is None) == none] for none in (False, True))
    right = [sum(r.get("right", False) for r in group) for group in (hidden, plain)]
    print(f"{name}: {right[0]} of {len(hidden)} right; without: {len(plain) - right[1]} of {len(plain)} false")
    return rows
