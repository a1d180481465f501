"""An excitation designed by gradient to shrink one error bar.

    python examples/designed_excitation.py [--seed 0] [--realisations 400] [--steps 40]

How well a record will determine an entry of M, D, K can be said before it is taken: from the Jacobian of the simulation
by all parameters at a first, rough model. Here the coupling damping D[1,2] matters. Amplitudes and phases of a
multisine on each input are moved down the gradient of its predicted variance, through simulation, Jacobian and inverse
of the information; the power of each input stays what it was. Then many noisy records, simulated by SciPy with the
true system, are identified one by one to see whether the prediction holds.
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
SAMPLES = 1000
NOISE = 5e-5
"""Of the displacements [m]; a force of 1 N moves them by about 1e-2."""

LINES = np.arange(1, 41) / (SAMPLES * SAMPLING_TIME)
"""Frequencies of the multisine [Hz]: as many periods as fit, from 0.1 to 4 Hz."""

SPREAD = 0.15
"""Share of the power that stays on all lines alike, so that no record is blind to the rest of the model."""

CHOSEN = 4
"""D[1,2] among M[1,1], M[1,2], M[2,2], D[1,1], …"""

BATCH = 20

ROWS, COLUMNS = np.array([0, 0, 1]), np.array([0, 1, 1])


def symmetric(entries):
    """M, D, K from their upper triangles."""
    X = jnp.zeros((3, 2, 2)).at[:, ROWS, COLUMNS].set(entries.reshape(3, 3))
    return X.at[:, COLUMNS, ROWS].set(entries.reshape(3, 3))


def excitation(design):
    """Forces (samples × 2) with a mean square of 1 N² each, from (loudness, phase) × line × input."""
    loudness, phase = design
    share = SPREAD / len(LINES) + (1 - SPREAD) * jax.nn.softmax(loudness, axis=0)
    t = SAMPLING_TIME * jnp.arange(SAMPLES)
    waves = jnp.cos(2 * jnp.pi * LINES[:, None] * t[:, None, None] + phase)
    return jnp.sum(jnp.sqrt(2 * share) * waves, axis=1)


def plain(rng):
    """Equal power on every line, random phases."""
    return jnp.zeros((len(LINES), 2)), jnp.asarray(rng.uniform(0, 2 * np.pi, (len(LINES), 2)))


def covariance(entries, u):
    """Covariance of the entries that a record with this input will have: first state and offsets estimated too."""

    def run(theta):
        model = jaxgray.MechanicalModel(*symmetric(theta[:9] * entries))
        return sampled(model.state_space(SAMPLING_TIME), 1.0, "zero").response(u, theta[9:13]) + theta[13:]

    J = jax.jacfwd(run)(jnp.concatenate([jnp.ones(9), jnp.zeros(6)])).reshape(-1, 15) / NOISE
    size = jnp.linalg.norm(J, axis=0)
    scaled = jnp.linalg.inv((J / size).T @ (J / size)) / size[:, None] / size
    return scaled[:9, :9] * entries[:, None] * entries


@jax.jit
def slope(design, entries):
    """ln of the chosen variance, and its gradient by the design."""
    return jax.value_and_grad(lambda d: jnp.log(covariance(entries, excitation(d))[CHOSEN, CHOSEN]))(design)


def designed(design, entries, steps):
    """The design after `steps` of optax."""
    optimiser = optax.adam(optax.cosine_decay_schedule(0.3, steps))
    state = optimiser.init(design)
    for _ in range(steps):
        _, gradient = slope(design, entries)
        change, state = optimiser.update(gradient, state)
        design = optax.apply_updates(design, change)
    return design


def measured(u):
    """Noise-free displacements from rest, by the matrix exponential of SciPy."""
    inverse, zero, eye = np.linalg.inv(MASS), np.zeros((2, 2)), np.eye(2)
    rates = np.block([[zero, eye, zero], [-inverse @ STIFFNESS, -inverse @ DAMPING, inverse], [np.zeros((2, 6))]])
    flow = scipy.linalg.expm(rates * SAMPLING_TIME)
    y, x = np.empty((len(u), 2)), np.zeros(4)
    for k in range(len(u)):
        y[k], x = x[:2], flow[:4] @ np.concatenate([x, u[k]])
    return y


@jax.jit
@jax.vmap
def _identified(u, y):
    found = jaxgray.estimate(u, y, SAMPLING_TIME, 0.05, block_rows=4, refinement_steps=3)
    return jnp.stack([found.mass, found.damping, found.stiffness])[:, ROWS, COLUMNS].ravel()


def identified(u, y):
    """Entries of M, D, K of every record y: subspace start, then Gauss-Newton; in batches, compiled once."""
    parts = [y[k : k + BATCH] for k in range(0, len(y), BATCH)]
    several = np.broadcast_to(u, (BATCH, *u.shape))
    padded = [np.resize(part, (BATCH, *part.shape[1:])) for part in parts]
    return np.concatenate([_identified(several, part)[: len(y) - k * BATCH] for k, part in enumerate(padded)])


def run(seed, realisations, steps):
    """Design from a rough model, then test the prediction.

    **Returns:** per excitation ("plain", "designed") a dictionary: `u`; `predicted`: variances of the nine entries by
    the rough model; `found`: those over the realisations; `design`.
    """
    rng = np.random.default_rng(seed)
    start = plain(rng)
    u = np.asarray(excitation(start))
    clean = measured(u)
    # The first record is five times as noisy: a rough model is enough for the design.
    rough = identified(u, clean + 5 * NOISE * rng.standard_normal((1, SAMPLES, 2)))[0]
    result = {}
    for name, design in (("plain", start), ("designed", designed(start, rough, steps))):
        u = np.asarray(excitation(design))
        y = measured(u) + NOISE * rng.standard_normal((realisations, SAMPLES, 2))
        found = identified(u, y)
        predicted = np.diag(np.asarray(_covariance(rough, u)))
        result[name] = {"u": u, "predicted": predicted, "found": found.var(axis=0, ddof=1), "design": design}
    return result


_covariance = jax.jit(covariance)


def main(argv=None):
    """Run the example, print the table, return what `run` does."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--realisations", type=int, default=400)
    parser.add_argument("--steps", type=int, default=40)
    arguments = parser.parse_args(argv)
    found = run(arguments.seed, arguments.realisations, arguments.steps)
    print("D[1,2] [N·s/m]: standard deviation   predicted   over the realisations   power of u1, u2 [N²]")
    for name, part in found.items():
        power = ", ".join(f"{p:.3f}" for p in np.mean(part["u"] ** 2, axis=0))
        print(
            "  {:30s} {:13.5f} {:23.5f}   {}".format(
                name, *(part[k][CHOSEN] ** 0.5 for k in ("predicted", "found")), power
            )
        )
    gain = found["plain"]["found"][CHOSEN] / found["designed"]["found"][CHOSEN]
    print(f"variance over the realisations: {gain:.2f} times smaller")
    share = 100 * np.asarray(jax.nn.softmax(found["designed"]["design"][0], axis=0))
    for j in range(2):
        loudest = sorted(np.argsort(-share[:, j])[:4])
        print(f"  u{j + 1}: " + ", ".join(f"{LINES[k]:.1f} Hz {share[k, j]:.0f} %" for k in loudest))
    return found


if __name__ == "__main__":
    main()
