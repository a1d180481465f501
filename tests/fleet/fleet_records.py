"""A small fleet on disk, from the independent simulator."""

import numpy as np
from independent import REFERENCE, random_steps, simulate

H = 0.02
SAMPLES = 1500
NOISE = 3e-4


def record(seed, *, stiffness=1.0, samples=SAMPLES):
    """Inputs and outputs of the reference system, its stiffness scaled."""
    rng = np.random.default_rng(seed)
    u = random_steps(rng, samples, 2, H, (0.2, 1.5))
    y = simulate(REFERENCE["M"], REFERENCE["D"], stiffness * REFERENCE["K"], u, H)
    return u, y + NOISE * rng.standard_normal(y.shape)


def write(path, u, y, *, h=H, temperature=20.0):
    """A record as NPZ, with a column of the temperature."""
    columns = {"u1": u[:, 0], "u2": u[:, 1], "y1": y[:, 0], "y2": y[:, 1]}
    np.savez(path, time=h * np.arange(len(u)), temperature=np.full(len(u), temperature), **columns)
