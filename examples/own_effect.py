"""An effect of one's own beside those of the catalogue: its law in one class, and a record that calls for it.

    python examples/own_effect.py [--samples 3000] [--without]

A mass on a spring whose force rises with the fifth power of its stretch is simulated by SciPy. The catalogue has no
such law; with the class `QuinticStiffness` appended, the diagnosis looks for it as for any other, fits it together
with mass, damping and stiffness, and judges it on data that the fit has not seen.
"""

import argparse

import jax
import numpy as np
import scipy.integrate

import jaxgray
from jaxgray.mechanics.effects.base import AbstractForceEffect, Parameter

jax.config.update("jax_enable_x64", True)

MASS, DAMPING, STIFFNESS, QUINTIC = 1.5, 2.0, 150.0, 3e4
SAMPLING_TIME = 0.01
NOISE = 5e-4


class QuinticStiffness(AbstractForceEffect):
    """A spring that hardens with the fifth power of its stretch."""

    id = "quintic_stiffness"
    family = "stiffness"
    law = "f = k5·q⁵"
    # Exponents of force, length and time in the unit; an amplitude enters the force linearly.
    parameters = (Parameter("k5", (1, -5, 0), amplitude=True),)
    parity = "odd"
    signature = "fifth harmonic in phase with the displacement"
    reference = "Kovacic & Brennan, The Duffing Equation, Wiley 2011"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * here.q**5


def simulated(rng, samples):
    """A noisy record of the mass under random steps of force."""
    u = np.repeat(rng.uniform(-12, 12, samples // 20 + 1), 20)[:samples]

    y, x = np.empty(samples), np.zeros(2)
    # In pieces of one step of the force, so that no step of the integrator runs over its edge.
    for k in range(0, samples, 20):
        t = SAMPLING_TIME * np.arange(k, min(k + 20, samples) + 1)

        def rates(_, x, force=u[k]):
            return [x[1], (force - DAMPING * x[1] - STIFFNESS * x[0] - QUINTIC * x[0] ** 5) / MASS]

        run = scipy.integrate.solve_ivp(rates, (t[0], t[-1]), x, t_eval=t, rtol=1e-9, atol=1e-11)
        y[k : k + len(t) - 1], x = run.y[0, :-1], run.y[:, -1]
    return jaxgray.Record(u, y + NOISE * rng.standard_normal(samples), SAMPLING_TIME)


def main(argv=None):
    """Simulate, diagnose with the law (and without it, if asked), print what is said; return the diagnosis."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=3000)
    parser.add_argument("--without", action="store_true", help="show what is said without the law, too")
    arguments = parser.parse_args(argv)
    rng = np.random.default_rng(4)
    estimation, validation = simulated(rng, arguments.samples), simulated(rng, arguments.samples)
    if arguments.without:
        print(f"Without the law:\n{jaxgray.diagnose(estimation, validation=validation)}\n")
    found = jaxgray.diagnose(estimation, validation=validation, catalogue=(*jaxgray.CATALOGUE, QuinticStiffness()))
    print(f"With the law (k5 = {QUINTIC:g} was simulated):\n{found}")
    return found


if __name__ == "__main__":
    main()
