"""Judges a user's own numbers, wrong on purpose, and a manipulator whose piezo actuator has hysteresis.

    python benchmarks/own_model.py --seed S [--records 10] [--samples 3000] [--cache DIR]

Data come from an independent simulator (tests/hidden.py). `--model` rows: one entry on the diagonal of M is 5 % wrong,
alone and with dry friction hidden as well. Manipulator: natural frequencies 83.107 and 96.729 Hz, 10 kHz, play at u2 in
two strengths.
"""

import argparse
import os
import pathlib
import sys
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

WRONG = 0.05
SAMPLING_TIME = 1e-4
PLAY_RADII = (0.4, 1.0, 1.6)


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
    parser.add_argument("--cache", help="folder that keeps compiled programs for the next run")
    arguments = parser.parse_args()
    if arguments.cache:
        jax.config.update("jax_compilation_cache_dir", arguments.cache)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own_models(arguments.seed, arguments.records, arguments.samples)
        for strength in (2.0, 3.0):
            manipulator(arguments.seed, strength)


if __name__ == "__main__":
    main()
