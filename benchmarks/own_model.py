"""Judges a user's own numbers, wrong on purpose, and a manipulator whose piezo actuator has hysteresis.

    python benchmarks/own_model.py --seed S [--records 10] [--samples 3000] [--rows ROW,…] [--cache DIR]

Data come from an independent simulator (tests/hidden.py). Rows: `entries`: one entry on the diagonal of M is 5 % wrong,
alone and with dry friction hidden as well. `laws`: a model that has two laws, as one that was saved has, with one
number 5 % off (of a law, or of an entry), with a third law missing, or with nothing wrong. `manipulator`: natural
frequencies 83.107 and 96.729 Hz, 10 kHz, play at u2 in two strengths.
"""

import argparse
import dataclasses
import os
import pathlib
import sys
import time
import warnings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("JAXGRAY_PROGRAMS", "0")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import hidden  # noqa: E402
from accuracy.systems import micro_manipulator  # noqa: E402
from hidden_laws import Effect  # noqa: E402
from hidden_simulation import System, simulate  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.mechanics.effects import by_id  # noqa: E402
from jaxgray.mechanics.effects.base import Term, places_of  # noqa: E402

WRONG = 0.05
SAMPLING_TIME = 1e-4
PLAY_RADII = (0.4, 1.0, 1.6)
KINDS = ("number", "law", "nothing")
LAWS = (
    ("cubic_stiffness", "coulomb_friction", "input_delay"),
    ("quadratic_drag", "cubic_stiffness", "coulomb_friction"),
    ("coulomb_friction", "input_delay", "cubic_stiffness"),
    ("end_stop", "coulomb_friction", "quadratic_drag"),
    ("bilinear_stiffness", "quadratic_drag", "input_saturation"),
    ("input_quadratic", "coulomb_friction", "quadratic_stiffness"),
)
"""Two laws that a model has, and one that it lacks."""


def judged(rng, case):
    """What is said of M with one entry 5 % wrong: deviations of Δ in standard errors, and the laws that are found."""
    at = int(rng.integers(len(case.system.M)))
    mass = np.array(case.system.M, dtype=float)
    wrong = WRONG * mass[at, at]
    mass[at, at] += wrong
    records = [
        jaxgray.Record(u, y, case.sampling_time, hold=case.hold) for u, y in ((case.u, case.y), (case.u_v, case.y_v))
    ]
    own = jaxgray.MechanicalModel(mass, case.system.D, case.system.K)
    diagnosis = jaxgray.diagnose(records[0], validation=records[1], model=own)
    found = [finding for finding in diagnosis.findings if finding.stage == "model"]
    errors = [f for f in found if f.effect == "mass_error" and f.location == f"y{at + 1}"]
    laws = [f for f in found if f not in errors]
    delta = errors[0].parameters["delta"] if errors else None
    deviation = np.inf if delta is None else abs(delta.value + wrong) / delta.standard_error
    return deviation, laws


def own_models(seed, records, samples):
    """Counts of both rows."""
    for name in ("nothing else", "coulomb_friction"):
        right = within = 0
        for k in range(records):
            rng = np.random.default_rng([seed, len(name), k])
            size = {"dofs": (1, 2, 3), "samples": samples}
            if name == "nothing else":
                case = hidden.null_case(rng, "white", **size)
            else:
                case = hidden.random_case(rng, name, excess=(1.5, 4.0), **size)
            deviation, laws = judged(rng, case)
            truth = {(effect.id, effect.place) for effect in case.effects}
            members = [{(m.effect, m.location) for m in law.members} for law in laws]
            right += np.isfinite(deviation) and len(laws) == len(truth) and all(m & truth for m in members)
            within += deviation <= 3
            print(
                f"  {name} {k}: Δ off by {deviation:.1f} standard errors; laws {[law.effect for law in laws]}",
                flush=True,
            )
        print(f"mass 5 % wrong and {name}: {right}/{records} all right, Δ within 3 standard errors {within}/{records}")


def model_with(system, effects):
    """The package's model of a system and of laws that act in it."""
    plain = jaxgray.MechanicalModel(system.M, system.D, system.K)
    terms = []
    for effect in effects:
        law = by_id(effect.id)
        given = {name: list(np.atleast_1d(value)) for name, value in effect.parameters.items()}
        values = [given[p.name].pop(0) if given.get(p.name) else 0.0 for p in law.parameters]
        places = places_of(law, plain.input_names, plain.output_names)
        place = next(place for place in places if place.name == effect.place)
        terms.append(Term(law, place, law.bounded(np.array(values, dtype=float))))
    return dataclasses.replace(plain, effects=tuple(terms))


def with_wrong_number(rng, model):
    """The model with one number 5 % off, and how a diagnosis calls it: effect and place."""
    numbers = [(k, j) for k, t in enumerate(model.effects) for j, p in enumerate(t.effect.parameters) if p.amplitude]
    numbers += [(-1, j) for j in range(model.dofs)]
    k, j = numbers[rng.integers(len(numbers))]
    off = 1 + WRONG * rng.choice([-1, 1])
    if k < 0:
        stiffness = np.array(model.stiffness)
        stiffness[j, j] *= off
        return model.with_matrices(model.mass, model.damping, stiffness), ("stiffness_error", f"y{j + 1}")
    term, values = model.effects[k], np.array(model.effects[k].values)
    values[j] *= off
    terms = list(model.effects)
    terms[k] = dataclasses.replace(term, values=values)
    name = f"{term.effect.parameters[j].name} of {term.effect.id} at {term.place.name}"
    return dataclasses.replace(model, effects=tuple(terms)), ("parameter_error", name)


def saved_models(seed, records, samples):
    """Counts of models that have laws: right alone, right in class, wrong, and time."""
    counts = {kind: [0, 0, 0] for kind in KINDS}
    for k in range(records):
        kind, laws = KINDS[k % len(KINDS)], LAWS[(k // len(KINDS)) % len(LAWS)]
        rng = np.random.default_rng([seed, 77, k])
        ids = laws if kind == "law" else laws[:2]
        try:
            case = hidden.random_pair(rng, pair=ids, dofs=(1, 2), samples=samples, excess=(8.0, 20.0))
        except hidden.TooHard:
            continue
        known = case.effects[:2]
        own, truth = model_with(case.system, known), None
        if kind == "number":
            own, truth = with_wrong_number(rng, own)
        elif kind == "law":
            truth = case.effects[2].id, case.effects[2].place
        fit, held = (
            jaxgray.Record(u, y, case.sampling_time, hold=case.hold)
            for u, y in ((case.u, case.y), (case.u_v, case.y_v))
        )
        began = time.perf_counter()
        diagnosis = jaxgray.diagnose(fit, validation=held, model=own)
        seconds = time.perf_counter() - began
        found = [finding for finding in diagnosis.findings if finding.stage == "model"]
        names = [{(m.effect, m.location) for m in f.members} | {(f.effect, f.location)} for f in found]
        in_class = not found if truth is None else len(found) == 1 and truth in names[0]
        alone = in_class and (truth is None or len(names[0]) == 1)
        counts[kind] = [n + one for n, one in zip(counts[kind], (1, alone, in_class))]
        had = [f"{effect.id} at {effect.place}" for effect in known]
        print(
            f"  {k} {kind}: has {had}, truth {truth}, {diagnosis.verdict} {[sorted(n) for n in names]}, "
            f"{'right' if alone else 'in class' if in_class else 'WRONG'}, {seconds:.0f} s, "
            f"{diagnosis.baseline_excess:.2f} to {diagnosis.excess:.2f} times the noise",
            flush=True,
        )
    for kind, (total, alone, in_class) in counts.items():
        print(f"model with laws, {kind}: alone {alone}, in class {in_class} of {total}", flush=True)


def manipulator(seed, strength):
    """Fits before and after, and what is found, with play of some strength at u2."""
    rng = np.random.default_rng([seed, int(100 * strength)])
    weights = [strength * w for w in (0.4, 0.35, 0.25)]
    play = Effect("play_hysteresis", "u2", {"w": weights, "r": list(PLAY_RADII)})

    def record(samples):
        u = np.empty((samples, 2))
        for column in u.T:
            k = 0
            while k < samples:
                length = int(rng.uniform(0.002, 0.03) / SAMPLING_TIME)
                column[k : k + length] = rng.uniform(-2.0, 2.0)
                k += length
        y = simulate(System(*micro_manipulator()), u, SAMPLING_TIME, [play])
        return jaxgray.Record(u, y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape), SAMPLING_TIME)

    diagnosis = jaxgray.diagnose(record(10000), validation=record(6000))
    found = [(f.effect, f.location, [m.effect for m in f.members]) for f in diagnosis.findings if f.stage == "model"]
    fits = [s.fit_percent["validation"] for s in (diagnosis.baseline, diagnosis.extended) if s is not None]
    text = " → ".join(" and ".join(f"{value:.1f}" for value in fit.values()) for fit in fits)
    print(f"manipulator, play {strength}: {found}; held-out fits {text} %", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--records", type=int, default=10, help="records of each row")
    parser.add_argument("--samples", type=int, default=3000)
    parser.add_argument("--rows", default="entries,laws,manipulator")
    parser.add_argument("--cache", help="folder that keeps compiled programs for the next run")
    arguments = parser.parse_args()
    if arguments.cache:
        jax.config.update("jax_compilation_cache_dir", arguments.cache)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = arguments.rows.split(",")
        if "entries" in rows:
            own_models(arguments.seed, arguments.records, arguments.samples)
        if "laws" in rows:
            saved_models(arguments.seed, arguments.records, arguments.samples)
        for strength in (2.0, 3.0) if "manipulator" in rows else ():
            manipulator(arguments.seed, strength)


if __name__ == "__main__":
    main()
