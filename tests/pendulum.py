"""A driven pendulum with gravity, Coulomb friction and damping, as a user may have it, and with a law that it lacks.

J q̈ = u + w − mgl sin q − d q̇ − Fc sign(q̇) − law(q, q̇), Runge-Kutta of order four in steps of a fraction of a sample,
inputs held; independent of the package.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal

TRUTH = {"inertia": 0.1, "damping": 0.08, "gravity": 2.0, "friction": 0.15}
STEPS = 8
TURN = 1e-3
"""Velocity [rad/s] over which friction turns."""


def nothing(p, q, v):
    return 0.0 * q


def cubic(p, q, v):
    return p * q**3


def drag(p, q, v):
    return p * v * jnp.abs(v)


def coulomb(p, q, v):
    return p * jnp.tanh(v / TURN)


def stop(p, q, v):
    return 20.0 * (jnp.maximum(q - p, 0.0) + jnp.minimum(q + p, 0.0))


def cogging(p, q, v):
    return p * jnp.sin(12.0 * q)


LAWS = {
    "cubic_stiffness": cubic,
    "quadratic_drag": drag,
    "coulomb_friction": coulomb,
    "end_stop": stop,
    "sine_stiffness": cogging,
}


@functools.partial(jax.jit, static_argnames=("law", "steps"))
def _run(force, numbers, size, h, law, steps):
    inertia, damping, gravity, friction = numbers

    def slope(x, f):
        q, v = x
        held = f - gravity * jnp.sin(q) - damping * v - friction * jnp.tanh(v / TURN) - law(size, q, v)
        return jnp.array([v, held / inertia])

    def sample(x, f):
        dt = h / steps

        def step(_, x):
            a = slope(x, f)
            b = slope(x + dt / 2 * a, f)
            c = slope(x + dt / 2 * b, f)
            d = slope(x + dt * c, f)
            return x + dt / 6 * (a + 2 * b + 2 * c + d)

        return jax.lax.fori_loop(0, steps, step, x), x[0]

    return jax.lax.scan(sample, jnp.zeros(2), force)[1]


def run(force, numbers=TRUTH, law=nothing, size=0.0, *, h=0.01, steps=STEPS):
    """Angles at the samples under held torques."""
    with jax.enable_x64(True):
        values = jnp.array([numbers[name] for name in TRUTH])
        return np.asarray(_run(jnp.asarray(np.asarray(force, float)), values, size, h, law, steps))


def simulator(u, w, numbers):
    """As a user's simulator is called."""
    return run(u[:, 0] + w[:, 0], numbers)


def torque(samples, rng, *, h=0.01, highest=2.0, size=0.8):
    """Band-limited torque."""
    sections = scipy.signal.butter(4, 2 * highest * h, output="sos")
    u = scipy.signal.sosfilt(sections, rng.standard_normal(samples))
    return size * u / u.std()


def off(rng, share=0.03):
    """The numbers as a user has them, each off by a share."""
    return {name: value * (1 + share * rng.choice([-1, 1])) for name, value in TRUTH.items()}
