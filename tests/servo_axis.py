"""An axis that nothing holds, under a PD controller that follows a sum of sines, as its encoder shows it; independent
of the package.

The torque that acts is the recorded one, limited and some short steps late. The velocity goes in short steps of equal
torque, the position by their mean velocity.
"""

import numpy as np

import jaxgray

MASS, H, SAMPLES, NOISE, STEPS = 0.3, 0.005, 4000, 2e-4, 40
STIFFNESS, DAMPING = 40.0, 4.0
"""Of the controller."""


def friction(size):
    return lambda q, v: size * np.tanh(v / 1e-3)


def axis(seed, *, zero=0.0, damping=0.0, law=None, limit=np.inf, late=0, samples=SAMPLES):
    """A record of the axis.

    **Arguments:** `seed`; `zero`: what the encoder shows where the axis stands at 0 [rad]; `damping` [N m s/rad];
    `law`: of position and velocity, to a torque against the motion [N m]; `limit` of the torque [N m]; `late`: short
    steps by which it acts later; `samples`.
    """
    rng = np.random.default_rng(seed)
    t = H * np.arange(samples)
    rates, phases = rng.uniform(0.1, 3.0, 12), rng.uniform(0, 2 * np.pi, 12)
    wanted = np.sum(np.sin(2 * np.pi * rates * t[:, None] + phases) / np.sqrt(1 + rates), axis=1)
    wanted *= 0.2 / wanted.std()
    noise = NOISE * rng.standard_normal(samples)
    u, y, acting = np.zeros(samples), np.zeros(samples), np.zeros((samples + 1) * STEPS + late)
    q, v, short = wanted[0], 0.0, H / STEPS
    last = q, q
    for k in range(samples):
        seen = q + noise[k]
        u[k] = STIFFNESS * (wanted[k] - seen) + DAMPING * ((wanted[k] - last[0]) - (seen - last[1])) / H
        last, y[k] = (wanted[k], seen), seen + zero
        acting[k * STEPS + late :] = np.clip(u[k], -limit, limit)
        for j in range(k * STEPS, (k + 1) * STEPS):
            against = damping * v + (0.0 if law is None else law(q, v))
            new = v + short * (acting[j] - against) / MASS
            q, v = q + short * (v + new) / 2, new
    return jaxgray.Record(u, y, H, input_units=["N m"], output_units=["rad"])
