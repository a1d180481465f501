"""Time constant and weights of the samples, learned by gradient on held-out fit.

    python examples/learned_weights.py [--unseen 6] [--steps 40]

A press next door shakes the sensors of a machine once in every cycle; nobody wrote down when. By default every sample
counts alike, and the time constant τ of the filter is the best of a grid. Here `jaxgray.estimate`, record to M, D, K as
one pure function, stands inside a loss: fit on one half of every training record, with weights over the cycle that are
still to be found, and judge by the free run on its other half. Its gradient says which phase of the cycle to trust.
What is learned on a few records serves every later one of the machine.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.linalg

import jaxgray
from jaxgray.mechanics.systems.statespace import sampled

jax.config.update("jax_enable_x64", True)

MASS = np.array([[2.0, -0.2], [-0.2, 1.0]])
DAMPING = np.array([[3.0, -0.5], [-0.5, 2.0]])
STIFFNESS = np.array([[300.0, -100.0], [-100.0, 200.0]])
SAMPLING_TIME = 0.01
SAMPLES = 1200
CYCLE = 300
"""Samples of one cycle of the press."""

BLOCK_ROWS = 4
KNOTS = 12
"""Phases of the cycle at which the weight is free; linear in between."""

PHASE = np.arange(SAMPLES) % CYCLE / CYCLE


def simulated(rng):
    """Forces, noise-free and measured displacements, sample by sample by the matrix exponential of SciPy."""
    u = np.repeat(rng.choice([-1.0, 1.0], (SAMPLES // 20, 2)), 20, axis=0)
    inverse, zero, eye = np.linalg.inv(MASS), np.zeros((2, 2)), np.eye(2)
    rates = np.block([[zero, eye, zero], [-inverse @ STIFFNESS, -inverse @ DAMPING, inverse], [np.zeros((2, 6))]])
    flow = scipy.linalg.expm(rates * SAMPLING_TIME)
    clean, x = np.empty((SAMPLES, 2)), np.zeros(4)
    for k in range(SAMPLES):
        clean[k], x = x[:2], flow[:4] @ np.concatenate([x, u[k]])
    shaken = np.where((PHASE > 0.3) & (PHASE < 0.45), 20.0, 1.0)
    noise = 0.01 * clean.std(axis=0) * shaken[:, None] * rng.standard_normal(clean.shape)
    return u, clean, clean + noise


def weights_of(theta):
    """Weight of every sample, positive, periodic with the cycle."""
    return jnp.exp(jnp.interp(PHASE, jnp.arange(KNOTS) / KNOTS, theta[1:], period=1.0))


def fitted(theta, u, y):
    """The model with τ = exp(theta[0]) and weights by the rest of theta."""
    return jaxgray.estimate(
        u,
        y,
        SAMPLING_TIME,
        jnp.exp(theta[0]),
        block_rows=BLOCK_ROWS,
        sample_weights=weights_of(theta),
        input_matrix_from="record",
    )


def free_run(found, u):
    """Simulation from rest."""
    model = jaxgray.MechanicalModel(found.mass, found.damping, found.stiffness)
    return sampled(model.state_space(SAMPLING_TIME), 1.0, "zero").response(u)


def held_out_loss(theta, record):
    """ln of the held-out error, by a mean that the shaken samples of the held-out half do not rule."""
    (u, y), (u_held, y_held) = record
    error = (free_run(fitted(theta, u, y), u_held) - y_held) / jnp.std(y_held, axis=0)
    return jnp.log(jnp.mean(jnp.log1p((error / 0.02) ** 2)))


@jax.jit
def slope(theta, records):
    """Mean loss over the records, and its gradient: forward, since theta is short."""

    def mean(theta):
        value = jnp.mean(jax.vmap(held_out_loss, (None, 0))(theta, records))
        return value, value

    return jax.jacfwd(mean, has_aux=True)(theta)


def learned(records, steps):
    """theta after `steps` of optax on training records, from equal weights and τ = 0.05 s."""
    theta = jnp.zeros(KNOTS + 1).at[0].set(np.log(0.05))
    optimiser = optax.adam(optax.cosine_decay_schedule(0.3, steps))
    state = optimiser.init(theta)
    for _ in range(steps):
        gradient, _ = slope(theta, records)
        change, state = optimiser.update(gradient, state)
        theta = optax.apply_updates(theta, change)
    return theta


def error(found, u, clean):
    """Root mean square error of the free run relative to the noise-free motion."""
    return float(np.sqrt(np.mean(((np.asarray(free_run(found, u)) - clean) / clean.std(axis=0)) ** 2)))


def run(train_seed, unseen_seeds, steps):
    """Learn on four records, then compare with the default on records that neither has seen.

    **Returns:** a dictionary: `theta`; `default` and `learned`: error on new motion, one per unseen record.
    """
    rng = np.random.default_rng(train_seed)
    halves = [[(u, y) for u, _, y in (simulated(rng), simulated(rng))] for _ in range(4)]
    theta = learned(jax.tree.map(lambda *parts: jnp.stack(parts), *halves), steps)
    errors = {"default": [], "learned": []}
    for seed in unseen_seeds:
        rng = np.random.default_rng(seed)
        (u, _, y), (u_new, clean, _) = simulated(rng), simulated(rng)
        default = jaxgray.identify(jaxgray.Record(u, y, SAMPLING_TIME), refine=False)
        errors["default"].append(error(default, u_new, clean))
        errors["learned"].append(error(_fitted(theta, u, y), u_new, clean))
    return {"theta": np.asarray(theta), **{name: np.array(values) for name, values in errors.items()}}


_fitted = jax.jit(fitted)


def main(argv=None):
    """Run the example, print the tables, return what `run` does."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--unseen", type=int, default=6)
    parser.add_argument("--steps", type=int, default=40)
    arguments = parser.parse_args(argv)
    found = run(0, range(1000, 1000 + arguments.unseen), arguments.steps)
    weights = np.exp(found["theta"][1:] - found["theta"][1:].max())
    print(f"learned: τ = {np.exp(found['theta'][0]):.4f} s, and the weight over the cycle (shaken from 0.30 to 0.45):")
    print("  phase  " + " ".join(f"{k / KNOTS:5.2f}" for k in range(KNOTS)))
    print("  weight " + " ".join(f"{w:5.2f}" for w in weights))
    print(f"error of the free run on {arguments.unseen} unseen records, in % of the motion:")
    print("           lower quartile   median   upper quartile")
    for name in ("default", "learned"):
        low, middle, high = 100 * np.quantile(found[name], [0.25, 0.5, 0.75])
        print(f"  {name:8s} {low:14.3f} {middle:8.3f} {high:16.3f}")
    return found


if __name__ == "__main__":
    main()
