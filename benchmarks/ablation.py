"""What every rule of the search buys: the records of `yardstick.py` once with all rules, noting which of them act, and
those in which one acts once more without it.

    python benchmarks/ablation.py --store ALL.json [--sets nulls,pairs] [--share 0.5] [--data DIR] [--cache DIR]
    python benchmarks/ablation.py --store ALL.json --without RULE[,RULE...] --folder DIR [--cache DIR]
    python benchmarks/ablation.py --report ALL.json --folder DIR

A rule acts in a record where it gives something else than what stands for it where it is switched off. One that acts in
no record buys nothing there; of the others the second command keeps `RULE.json` in a folder, and the third counts which
answers are better and worse without them.
"""

import argparse
import dataclasses
import functools
import importlib
import inspect
import json
import pathlib
import sys
from collections.abc import Callable

import yardstick  # sets the backend up

import jax  # isort: skip

PACKAGE = "jaxgray.diagnosis"


@dataclasses.dataclass(frozen=True)
class Rule:
    """A function of the search, `module` and `name`; `nothing`: of its arguments, what it gives where it is off;
    `state`: argument that it changes instead."""

    module: str
    name: str
    nothing: Callable
    state: str = ""

    @property
    def function(self) -> Callable:
        """The rule itself."""
        return getattr(importlib.import_module(f"{PACKAGE}.{self.module}"), self.name)


def given(name: str) -> Callable:
    """Gives back one of its arguments."""
    return lambda bound: bound[name]


def fixed(value) -> Callable:
    """Gives one value whatever its arguments."""
    return lambda bound: value


def empty(kind: type) -> Callable:
    """Gives nothing of a kind."""
    return lambda bound: kind()


RULES = (
    Rule("estimation.continuation", "along_the_valley", given("fit")),
    Rule("estimation.continuation", "with_sharp_edge", given("fit")),
    Rule("estimation.continuation", "sharpened", given("fit")),
    Rule("estimation.element_sums", "from_other_thresholds", given("fit")),
    Rule("estimation.element_sums", "at_fewer_thresholds", given("fit")),
    Rule("estimation.change_points", "from_other_change_points", given("fit")),
    Rule("estimation.change_points", "from_near_change_points", given("fit")),
    Rule("estimation.change_points", "softened", lambda bound: [bound["term"]]),
    Rule("estimation.change_points", "dated", given("candidate")),
    Rule("estimation.multistart", "_from_wider", empty(dict)),
    Rule("estimation.multistart", "by_contact", given("attempt")),
    Rule("estimation.multistart", "_in_place_of_element", empty(list)),
    Rule("estimation.measured_motion", "along_measured_motion", fixed(None)),
    Rule("starts.equation_error", "from_first_trials", empty(list)),
    Rule("starts.equation_error", "from_forces", empty(list)),
    Rule("starts.force_matching", "force_matched", empty(list)),
    Rule("starts.lookalikes", "refit_look_alikes", empty(list)),
    Rule("starts.lookalikes", "at_other_places", empty(list)),
    Rule("starts.lookalikes", "as_likely_places", empty(list)),
    Rule("starts.lookalikes", "contained_laws", empty(list)),
    Rule("starts.other_models", "from_other_models", empty(list)),
    Rule("starts.residual_modes", "hidden_modes", empty(list)),
    Rule("starts.windows", "changes_over_time", empty(dict)),
    Rule("starts.first_states", "without_free_offset", given("start")),
    Rule("screening.linearization", "run_about", fixed(None)),
    Rule("screening.shortlist", "in_other_forms", empty(list)),
    Rule("screening.shortlist", "at_lines", empty(list)),
    Rule("screening.spectral_lines", "lines_of", empty(tuple)),
    Rule("search.confusable", "commonest_first", given("ranked")),
    Rule("search.proposals", "strong", fixed(False)),
    Rule("search.proposals", "without_failed", fixed(None)),
    Rule("search.proposals", "narrowed", given("ranked")),
    Rule("search.acceptance", "_is_feedback", fixed(False)),
    Rule("search.forward", "_refuted", fixed(False)),
    Rule("search.forward", "_along_branches", given("state")),
    Rule("search.forward", "_provisional", fixed(False)),
    Rule("search.backward", "_unite", fixed(None), "state"),
    Rule("search.backward", "_unite_alike", fixed(None), "state"),
    Rule("search.backward", "_dropped", fixed(False)),
    Rule("search.restart", "for_the_free_run", fixed(None), "state"),
    Rule("search.swap", "swap", fixed(None), "state"),
    Rule("search.swap", "call_by_contact", fixed(None), "state"),
)


def snapshot(state) -> tuple:
    """What tells one state of the search from another."""
    names = [[rival.name for rival in one.rivals] for one in state.accepted]
    return id(state.fit), [id(one.attempt.fit) for one in state.accepted], names


def differs(one, other) -> bool:
    """Whether a rule gave something else than where it is off."""
    if isinstance(one, (list, tuple, dict)) and isinstance(other, (list, tuple, dict)):
        return len(one) != len(other) or any(a is not b for a, b in zip(one, other))
    return one is not other and not (isinstance(one, bool) and one == other)


def watched(rule: Rule, function: Callable, acted: set[str]) -> Callable:
    """A rule that notes where it acts."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def watching(*arguments, **more):
        bound = signature.bind(*arguments, **more).arguments
        before = snapshot(bound[rule.state]) if rule.state else None
        made = function(*arguments, **more)
        here = snapshot(bound[rule.state]) != before if rule.state else differs(made, rule.nothing(bound))
        acted.update([rule.name] if here else [])
        return made

    return watching


def switched_off(rule: Rule, function: Callable) -> Callable:
    """What stands for a rule that is off."""
    signature = inspect.signature(function)
    return functools.wraps(function)(lambda *a, **more: rule.nothing(signature.bind(*a, **more).arguments))


def put(function: Callable, other: Callable) -> None:
    """Another function in the place of one, wherever the package calls it."""
    for name, module in list(sys.modules.items()):
        if not name.startswith(PACKAGE):
            continue
        for key, value in list(vars(module).items()):
            if value is function:
                setattr(module, key, other)
            elif isinstance(value, tuple) and any(isinstance(x, tuple) and function in x for x in value):
                setattr(module, key, tuple(tuple(other if y is function else y for y in x) for x in value))


def key_of(row: dict) -> tuple:
    """Set, truth and number."""
    return row["set"], row["truth"], row["number"]


def report(every: list[dict], folder: pathlib.Path) -> None:
    """What the answers are worth without each rule."""
    print(f"{len(every)} records\n{'rule':26s} {'acts':>5s}   without: again better worse  time")
    for rule in RULES:
        here = {key_of(row): row for row in every if rule.name in row["acted"]}
        path, line = folder / f"{rule.name}.json", f"{rule.name:26s} {len(here):5d}"
        if not path.exists():
            print(line)
            continue
        without = [row for row in json.loads(path.read_text()) if key_of(row) in here]
        change = [(row, row["worth"] - here[key_of(row)]["worth"]) for row in without]
        better, worse = ([row for row, c in change if sign * c > 0] for sign in (1, -1))
        times = [row.get("seconds", 0.0) for row in without], [here[key_of(row)].get("seconds", 0.0) for row in without]
        ratio = sum(times[0]) / max(sum(times[1]), 1e-9)
        print(f"{line}            {len(without):5d}  {len(better):5d} {len(worse):5d} {ratio:5.2f}×")
        for sign, rows in ("better", better), ("worse", worse):
            for row in rows:
                old = here[key_of(row)]
                print(f"    {sign} {' '.join(map(str, key_of(row)))}: {old.get('found')} → {row.get('found')}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=pathlib.Path, help="file of answers with all rules, to make or to complete")
    parser.add_argument("--without", help="rules to switch off, one after the other")
    parser.add_argument("--report", type=pathlib.Path, metavar="ALL")
    parser.add_argument("--folder", type=pathlib.Path, help="of answers without each rule")
    parser.add_argument("--sets", default="singles,nulls,pairs,several")
    parser.add_argument("--share", type=float, default=1.0, help="share of the simulated records, the same ones always")
    parser.add_argument("--data", type=pathlib.Path, help="folder of measured records")
    parser.add_argument("--cache", help="folder that keeps compiled programs for the next run")
    asked = parser.parse_args()
    if asked.report and asked.folder is None:
        parser.error("give --report ALL.json with a --folder")
    if asked.report:
        report(json.loads(asked.report.read_text()), asked.folder)
        return
    if asked.store is None or (asked.without and asked.folder is None):
        parser.error("give --store ALL.json, with --without RULE a --folder as well, or --report ALL.json --folder DIR")
    if asked.cache:
        jax.config.update("jax_compilation_cache_dir", asked.cache)
    importlib.import_module(f"{PACKAGE}.diagnose")
    if not asked.without:
        acted: set[str] = set()
        for rule in RULES:
            put(rule.function, watched(rule, rule.function, acted))

        def noted():
            names = sorted(acted)
            acted.clear()
            return {"acted": names}

        yardstick.store(asked.store, asked.sets.split(","), asked.share, asked.data, more=noted)
        return
    known = {rule.name: rule for rule in RULES}
    every, names = json.loads(asked.store.read_text()), asked.without.split(",")
    if unknown := [name for name in names if name not in known]:
        parser.error(f"--without {unknown[0]}: no such rule; give some of {', '.join(known)}")
    asked.folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        rule = known[name]
        function, here = rule.function, {key_of(row) for row in every if name in row["acted"]}
        off = switched_off(rule, function)
        put(function, off)
        sets = asked.sets.split(",")
        yardstick.store(asked.folder / f"{name}.json", sets, 1.0, asked.data, wanted=here.__contains__)
        put(off, function)


if __name__ == "__main__":
    main()
