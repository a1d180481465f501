"""A force without a name: a small network beside M, D, K learns it, and M, D, K come out right.

    python examples/learned_force.py [--samples 1500] [--seed 0] [--gallery FILE]

The magnets of a motor pull its rotor towards every pole, by a law that no catalogue lists: periodic in the angle, with
sharp flanks. A linear model blames it on mass, damping and stiffness. Here the model of rotor and load is an
Equinox layer whose matrices are physical and whose missing force is a network, simulated together by jaxgray and
trained end to end: optax first, then least squares to the very optimum, since error bars hold only there. The network
sees the angle within one pole pitch alone. Over several pitches no such force looks like a spring, a damper or an
inertia, so that the three keep their meaning, and their standard errors count what the network may take from them.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.integrate
import scipy.optimize
from jax.flatten_util import ravel_pytree

import jaxgray
from jaxgray.manual.gallery import keep
from jaxgray.mechanics.effects.base import AbstractForceEffect, Parameter, Place, Term
from jaxgray.mechanics.runs.extended import Plant, extended_run

jax.config.update("jax_enable_x64", True)

MASS = np.array([[1.0, 0.0], [0.0, 0.6]])
DAMPING = np.array([[2.0, -0.4], [-0.4, 1.2]])
STIFFNESS = np.array([[60.0, -25.0], [-25.0, 45.0]])
PITCH = 0.8
"""Angle between two poles [rad]."""

SAMPLING_TIME = 0.01
NOISE = 0.005
"""Of the angles [rad]; they move by about 1."""

HELD = 25
"""Samples for which the torques keep their value."""


def hidden_torque(angle):
    """What the magnets do, as the simulator knows it."""
    phase = 2 * np.pi * angle / PITCH
    return 4.0 * np.sin(phase + 0.4) / (1.4 + np.cos(phase))


def simulated(rng, samples):
    """A noisy record of rotor and load from rest, both driven by random steps of torque, by SciPy."""
    u = np.repeat(rng.uniform(-60, 60, (samples // HELD + 1, 2)) * [1.0, 0.5], HELD, axis=0)[:samples]
    inverse = np.linalg.inv(MASS)
    y, x = np.empty((samples, 2)), np.zeros(4)
    for k in range(0, samples, HELD):
        t = SAMPLING_TIME * np.arange(min(HELD, samples - k) + 1)

        def rates(_, x, torque=u[k]):
            missing = np.array([hidden_torque(x[0]), 0.0])
            return np.concatenate([x[2:], inverse @ (torque - DAMPING @ x[2:] - STIFFNESS @ x[:2] - missing)])

        run = scipy.integrate.solve_ivp(rates, (0.0, t[-1]), x, "DOP853", t_eval=t, rtol=1e-8, atol=1e-10)
        y[k : k + len(t) - 1], x = run.y[:2, :-1].T, run.y[:, -1]
    return jaxgray.Record(u, y + NOISE * rng.standard_normal(y.shape), SAMPLING_TIME)


def new_network(key):
    """From (sin, cos) of the angle within the pitch to a torque."""
    network = eqx.nn.MLP(2, "scalar", width_size=8, depth=1, activation=jnp.tanh, key=key)
    return eqx.tree_at(lambda n: n.layers[1].weight, network, 0.1 * network.layers[1].weight)


PATTERN, STATIC = eqx.partition(new_network(jax.random.key(0)), eqx.is_array)
FLAT, UNRAVEL = ravel_pytree(PATTERN)


class NetworkForce(AbstractForceEffect):
    """The network as a law like those of the catalogue: its weights are the parameters."""

    id = "network_force"
    family = "stiffness"
    law = "f = network(sin(2π·q/pitch), cos(2π·q/pitch))"
    parameters = tuple(Parameter(f"weight {k}", (1, 0, 0)) for k in range(len(FLAT)))
    signature = "periodic in the displacement"
    reference = "Hornik, Neural Networks 4 (1991) 251-257"
    places = "coordinate"

    def shapes(self, scales):
        return [np.array(FLAT)]

    def force(self, p, here, z):
        phase = 2 * jnp.pi * here.q / PITCH
        return eqx.combine(UNRAVEL(p), STATIC)(jnp.stack([jnp.sin(phase), jnp.cos(phase)]))


class Drive(eqx.Module):
    """Rotor and load as a layer: torques in, angles out.

    `factors`: lower triangles of the Cholesky factors of M, D, K, so that every step of a training is physical;
    `sizes`: their units; `network`.
    """

    factors: jax.Array
    network: eqx.nn.MLP
    sizes: tuple[float, ...] = eqx.field(static=True)

    def matrices(self):
        """M, D, K."""
        lower = jnp.zeros((3, 2, 2)).at[:, [0, 1, 1], [0, 0, 1]].set(self.factors)
        return jnp.einsum("kij,klj->kil", lower, lower) * jnp.asarray(self.sizes)[:, None, None]

    def model(self):
        """The plant, and the network as a term of it."""
        plant = Plant(*self.matrices(), jaxgray.Force(jnp.eye(2)), ("displacement",) * 2)
        weights = ravel_pytree(eqx.filter(self.network, eqx.is_array))[0]
        return plant, Term(NetworkForce(), Place("y1", 0), weights)

    def __call__(self, u):
        plant, term = self.model()
        return extended_run(plant, (term,), jnp.zeros(4), u, SAMPLING_TIME, "zero")


def entries(layer):
    """The upper triangles of M, D, K."""
    return layer.matrices()[:, [0, 0, 1], [0, 1, 1]].ravel()


@eqx.filter_jit
def step(layer, state, optimiser, u, y):
    """One step of optax down the gradient of the mean square error of the free run."""
    arrays, rest = eqx.partition(layer, eqx.is_array)
    loss, slope = jax.value_and_grad(lambda a: jnp.mean((eqx.combine(a, rest)(u) - y) ** 2) / NOISE**2)(arrays)
    change, state = optimiser.update(slope, state, arrays)
    return eqx.apply_updates(layer, change), state, loss


@eqx.filter_jit
def errors_and_slopes(theta, layer, u, y):
    """Residuals of the free run, and their Jacobian by all parameters."""
    arrays, rest = eqx.partition(layer, eqx.is_array)
    unravel = ravel_pytree(arrays)[1]

    def errors(theta):
        e = (eqx.combine(unravel(theta), rest)(u) - y).ravel() / NOISE
        return e, e

    slopes, e = jax.jacfwd(errors, has_aux=True)(theta)
    return e, slopes


def begun(record, key):
    """The layer before training: M, D, K of the best linear model, and a network that knows nothing.

    **Returns:** the layer, and the linear model.
    """
    linear = jaxgray.estimate(record.u, record.y, record.sampling_time, 0.05, refinement_steps=3)
    found = np.stack([linear.mass, linear.damping, linear.stiffness])
    sizes = np.trace(found, axis1=1, axis2=2) / 2
    lower = np.linalg.cholesky(found / sizes[:, None, None] + 1e-3 * np.eye(2))
    return Drive(
        jnp.asarray(lower[:, [0, 1, 1], [0, 0, 1]]), new_network(key), tuple(sizes.tolist())
    ), jaxgray.MechanicalModel(*found)


def trained(layer, record, steps=150):
    """Train a layer on a record: optax, then least squares.

    **Returns:** the layer, and the covariance of `entries`, the network's weights estimated too.
    """
    u, y = jnp.asarray(record.u), jnp.asarray(record.y)
    optimiser = optax.adam(optax.cosine_decay_schedule(0.03, steps))
    state = optimiser.init(eqx.filter(layer, eqx.is_array))
    for _ in range(steps):
        layer, state, _ = step(layer, state, optimiser, u, y)
    arrays, rest = eqx.partition(layer, eqx.is_array)
    theta, unravel = ravel_pytree(arrays)
    known = {}

    def both(theta):
        if known.get("at") != theta.tobytes():
            known["at"], known["value"] = theta.tobytes(), errors_and_slopes(jnp.asarray(theta), layer, u, y)
        return known["value"]

    end = scipy.optimize.least_squares(
        lambda t: np.asarray(both(t)[0]),
        np.asarray(theta),
        lambda t: np.asarray(both(t)[1]),
        x_scale="jac",
        max_nfev=30,
    )
    layer = eqx.combine(unravel(jnp.asarray(end.x)), rest)
    variance = 2 * end.cost / (len(end.fun) - len(end.x))
    by_theta = jax.jacfwd(lambda t: entries(eqx.combine(unravel(t), rest)))(jnp.asarray(end.x))
    # Weights that do not matter have no influence on the rest: the pseudoinverse leaves them out.
    spread = by_theta @ np.linalg.pinv(end.jac, rcond=1e-9)
    return layer, variance * spread @ spread.T


def nrmse(simulated, record):
    """Root mean square error relative to the motion, over both angles."""
    return float(np.sqrt(np.mean((simulated - record.y) ** 2) / np.mean((record.y - record.y.mean(axis=0)) ** 2)))


def run(seed, samples):
    """One record, learned; another, held out.

    **Returns:** a dictionary: `linear`, `joint`, `truth`: entries of M, D, K; `standard_errors` of `joint`; errors of
    the free run held out, relative to the motion, of `physics_alone`, `with_network`, and the `noise` in them.
    """
    rng = np.random.default_rng(seed)
    record, held_out = simulated(rng, samples), simulated(rng, samples)
    layer, linear = begun(record, jax.random.key(seed))
    layer, covariance = trained(layer, record)
    u = jnp.asarray(held_out.u)
    pick = (..., [0, 0, 1], [0, 1, 1])
    return {
        "linear": np.stack([linear.mass, linear.damping, linear.stiffness])[pick].ravel(),
        "joint": np.asarray(entries(layer)),
        "truth": np.stack([MASS, DAMPING, STIFFNESS])[pick].ravel(),
        "standard_errors": np.sqrt(np.diag(covariance)),
        "physics_alone": nrmse(linear.simulate(held_out.u, SAMPLING_TIME), held_out),
        "with_network": nrmse(np.asarray(eqx.filter_jit(layer)(u)), held_out),
        "noise": NOISE / float(np.std(held_out.y)),
        "layer": layer,
        "held_out": held_out,
        "runs": {
            "physics alone": np.asarray(linear.simulate(held_out.u, SAMPLING_TIME)),
            "with network": np.asarray(eqx.filter_jit(layer)(u)),
        },
    }


def shown(found):
    """Title, text, table and curves for the manual's gallery."""
    rows = [["entry", "truth", "linear model", "with network ± standard error"]]
    for k, name in enumerate(f"{X}[{i}]" for X in "MDK" for i in ("1,1", "1,2", "2,2")):
        row = (found[part][k] for part in ("truth", "linear", "joint", "standard_errors"))
        rows.append("{}|{:g}|{:.4f}|{:.4f} ± {:.4f}".format(name, *row).split("|"))
    errors = (f"{100 * found[name]:.2f} %" for name in ("noise", "physics_alone", "with_network"))
    rows.append(["error held out", *(f"{words} {value}" for words, value in zip(("noise", "", ""), errors))])
    angle = np.linspace(-PITCH, PITCH, 200)
    phase = 2 * np.pi * angle / PITCH
    learned = jax.vmap(found["layer"].network)(jnp.stack([jnp.sin(phase), jnp.cos(phase)], axis=1))
    # A constant of the network is the output offset's as well.
    forces = {"hidden": hidden_torque(angle), "learned": np.asarray(learned)}
    laws = [
        {"label": name, "role": role, "x": angle.tolist(), "y": (force - force.mean()).tolist()}
        for (name, force), role in zip(forces.items(), ("plain", "law"))
    ]
    part = slice(0, 300)
    time = (SAMPLING_TIME * np.arange(300)).tolist()
    runs = {"measured": found["held_out"].y} | found["runs"]
    lines = [
        {"label": name, "role": role, "x": time, "y": run[part, 0].tolist()}
        for (name, run), role in zip(runs.items(), ("plain", "second", "law"))
    ]
    return {
        "title": "A force without a name",
        "text": "The magnets of a motor pull its rotor towards every pole, by a law that no catalogue lists. A network "
        "beside M, D, K learns it from one record, and M, D, K come out right.",
        "table": rows,
        "panels": [
            {
                "title": "Torque of the magnets, mean taken off",
                "x_label": "angle [rad]",
                "y_label": "torque [N m]",
                "curves": laws,
            },
            {"title": "Rotor, held out", "x_label": "time [s]", "y_label": "angle [rad]", "curves": lines},
        ],
    }


def main(argv=None):
    """Run the example, print the table, return what `run` does."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gallery", type=Path, help="file for the manual's gallery (default: none)")
    arguments = parser.parse_args(argv)
    found = run(arguments.seed, arguments.samples)
    print("entry      truth   linear model   with network ± standard error")
    for k, name in enumerate(f"{X}[{i}]" for X in "MDK" for i in ("1,1", "1,2", "2,2")):
        row = (found[part][k] for part in ("truth", "linear", "joint", "standard_errors"))
        print("{:8s} {:7.3f}   {:12.4f}   {:12.4f} ± {:.4f}".format(name, *row))
    print(
        f"error held out: {100 * found['physics_alone']:.2f} % physics alone, {100 * found['with_network']:.2f} % with "
        f"the network, of which {100 * found['noise']:.2f} % is noise"
    )
    if arguments.gallery is not None:
        keep(shown(found), arguments.gallery)
    return found


if __name__ == "__main__":
    main()
