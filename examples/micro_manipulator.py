"""A fast, small system: the natural frequencies of the paper's micro manipulator, identified without tuning.

    python examples/micro_manipulator.py [--samples 20000] [--seed 1]

The paper's micro manipulator has natural frequencies of 83.107 and 96.729 Hz, masses of the order of 1e-6 in
its units, and is sampled at 10 kHz. The paper's matrices (27) and (28) are not reproduced here: this is a
stand-in with exactly these two frequencies. Masses of that size, modes turned by 30° against the coordinates,
2 % damping of both, and the units (N and µm, so that mass is in N s²/µm) are chosen by us. It shows that
close modes and numbers far from one need no scaling and no time constant chosen by hand. The data come from
SciPy.

Reference: Olofsson, Sörnmo, Robertsson & Johansson, Continuous-Time Gray-Box Identification of Mechanical
Systems Using Subspace-Based Identification Methods.
"""

import argparse

import jax
import numpy as np
import scipy.signal

import jaxgray
from jaxgray.mechanics.modal_uncertainty import modal_uncertainty

jax.config.update("jax_enable_x64", True)

FREQUENCIES_HZ = np.array([83.107, 96.729])
DAMPING_RATIO = 0.02
SAMPLING_TIME = 1e-4
NOISE = 0.01
"""Standard deviation of the noise relative to that of the output."""

ANGLE = np.radians(30.0)
MASS = np.diag([3.2e-6, 2.9e-6])
ROOT = np.sqrt(MASS)
TURN = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
OMEGA = 2 * np.pi * FREQUENCIES_HZ
STIFFNESS = ROOT @ TURN @ np.diag(OMEGA**2) @ TURN.T @ ROOT
DAMPING = ROOT @ TURN @ np.diag(2 * DAMPING_RATIO * OMEGA) @ TURN.T @ ROOT


def steps(rng, samples):
    """Independent ±1 steps on both coordinates, each held for 1 to 10 ms (samples × 2)."""
    u = np.empty((samples, 2))
    for column in u.T:
        k = 0
        while k < samples:
            length = int(rng.uniform(1e-3, 10e-3) / SAMPLING_TIME)
            column[k : k + length] = rng.choice([-1.0, 1.0])
            k += length
    return u


def measured(rng, samples):
    """A noisy record of the system from rest, exact for inputs held between samples."""
    zero, one = np.zeros((2, 2)), np.eye(2)
    A = np.block([[zero, one], [-np.linalg.solve(MASS, STIFFNESS), -np.linalg.solve(MASS, DAMPING)]])
    B = np.vstack([zero, np.linalg.inv(MASS)])
    system = scipy.signal.cont2discrete((A, B, np.eye(2, 4), zero), SAMPLING_TIME)
    u = steps(rng, samples)
    clean = scipy.signal.dlsim(system, u)[1]
    y = clean + NOISE * clean.std(axis=0) * rng.standard_normal(clean.shape)
    return jaxgray.Record(u, y, SAMPLING_TIME, input_units=("N", "N"), output_units=("µm", "µm"))


def main(argv=None):
    """Run the example.

    **Arguments:** `argv`: as on the command line; default that of the process.

    **Returns:** the numbers printed: `frequencies_hz`, `standard_errors_hz`, `damping_ratios`, `errors` of
    M, D, K, and the identification as `result`.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=20_000, help="of each record (default 20000)")
    parser.add_argument("--seed", type=int, default=1, help="of inputs and noise (default 1)")
    arguments = parser.parse_args(argv)

    rng = np.random.default_rng(arguments.seed)
    estimation, validation = (measured(rng, arguments.samples) for _ in range(2))
    result = jaxgray.identify(estimation, validation=validation)
    modes = result.model.modes()
    spread = modal_uncertainty(result.model, result.covariance)

    print(result)
    print("\nmode  true [Hz]   found ± standard error [Hz]   error      damping ratio (true 0.02)")
    for k, true in enumerate(FREQUENCIES_HZ):
        f, se = modes.natural_frequency_hz[k], spread.natural_frequency_hz[k]
        ratio, ratio_se = modes.damping_ratio[k], spread.damping_ratio[k]
        print(
            f"{k + 1:4d}  {true:9.3f}   {f:8.4f} ± {se:<8.1g}            {100 * (f / true - 1):+.4f} %  "
            f"{ratio:.5f} ± {ratio_se:.1g}"
        )
    pairs = zip((result.mass, result.damping, result.stiffness), (MASS, DAMPING, STIFFNESS))
    errors = tuple(float(np.linalg.norm(found - true) / np.linalg.norm(true)) for found, true in pairs)
    print("\nrelative errors: " + ", ".join(f"{name} {value:.5f}" for name, value in zip("MDK", errors)))
    return {
        "frequencies_hz": modes.natural_frequency_hz,
        "standard_errors_hz": spread.natural_frequency_hz,
        "damping_ratios": modes.damping_ratio,
        "errors": errors,
        "result": result,
    }


if __name__ == "__main__":
    main()
