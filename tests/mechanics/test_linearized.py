"""What a run with forces answers to small further forces, beside derivatives through the run and beside SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from forces import FORCES, SAMPLES
from independent import random_steps

from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.runs.extended import Plant, plant_run, slots_of
from jaxgray.mechanics.runs.linearized import answers, linearized
from jaxgray.mechanics.systems.drives import BaseAcceleration, Force

T = 0.02
STIFFNESS = np.array([[50.0, -20.0], [-20.0, 40.0]])


def parts_of(drive, terms):
    plant = Plant(np.diag([1.0, 1.5]), 0.01 * STIFFNESS, STIFFNESS, drive, ("displacement", "acceleration"))
    plant, laws = jax.tree.map(jnp.asarray, plant), tuple(term.effect for term in terms)
    return plant, slots_of(terms, plant, laws), laws


@pytest.mark.parametrize("forces, substeps", [("no memory", 3), ("memory", 1), ("at an input", 2)])
def test_answers_to_inputs_and_forces_are_derivatives_through_the_run(forces, substeps):
    rng = np.random.default_rng(5)
    plant, slots, laws = parts_of(Force(np.eye(2)), FORCES[forces])
    start, end, first, last = jnp.asarray(rng.normal(size=(4, SAMPLES, 2)).cumsum(axis=1))
    x0, more = rng.normal(size=4), {"laws": laws, "substeps": substeps}
    run = jax.jit(lambda: linearized(plant, x0, start, end, slots, T, **more))()
    column = np.array([1.0, -0.5])

    def moved(first, last):
        return plant_run(plant, x0, start + first, end + last, slots, T, **more)

    for channels in ([0], [0, 1]):
        here = np.where(np.isin([0, 1], channels), column, 0.0)
        series = first[:, 0], last[:, 0]
        change = tuple(one[:, None] * here for one in series)
        through = jax.jvp(jax.jit(moved), (jnp.zeros((SAMPLES, 2)),) * 2, change)[1]
        by_input = answers(run, here, *(one[None] for one in series), forced=False)[0]
        np.testing.assert_allclose(by_input, through, atol=1e-9 * np.abs(through).max())
        if forces != "at an input":
            # Inputs are forces at the coordinates here; but no law sees a force that is none of them.
            by_force = answers(run, here, *(one[None] for one in series), forced=True)[0]
            np.testing.assert_allclose(by_force, through, atol=1e-9 * np.abs(through).max())


def test_under_a_moving_base_a_force_is_answered_as_a_law_of_that_size():
    rng = np.random.default_rng(6)
    constant = Term(by_id("constant_force"), Place("y2", 1), np.array([1e-6]))
    terms, drive = FORCES["memory"], BaseAcceleration(np.ones((2, 1)))
    start, end = rng.normal(size=(2, SAMPLES, 1)).cumsum(axis=1)

    def outputs(terms):
        plant, slots, laws = parts_of(drive, terms)
        return plant_run(plant, np.zeros(4), start, end, slots, T, laws=laws)

    plant, slots, laws = parts_of(drive, terms)
    run = linearized(plant, np.zeros(4), start, end, slots, T, laws=laws)
    made = answers(run, np.array([0.0, -1.0]), *np.ones((2, 1, SAMPLES)), forced=True)[0]
    change = (outputs((*terms, constant)) - outputs(terms)) / 1e-6
    np.testing.assert_allclose(made, change, atol=2e-3 * np.abs(change).max())


def test_a_stiffening_spring_answers_as_scipy_has_it_and_the_plant_alone_does_not():
    rng, h, samples, k3, small = np.random.default_rng(7), 0.05, 400, 400.0, 1e-5
    mass, damping, stiffness = 1.0, 0.8, 60.0
    u, w = 40.0 * random_steps(rng, samples, 1, h)[:, 0], rng.standard_normal(samples)

    def motion(u):
        x, q = np.zeros(2), []
        for force in u:
            q.append(x[0])
            rate = lambda t, x, f=force: (x[1], (f - damping * x[1] - stiffness * x[0] - k3 * x[0] ** 3) / mass)  # noqa: E731
            x = scipy.integrate.solve_ivp(rate, (0.0, h), x, rtol=1e-11, atol=1e-13).y[:, -1]
        return np.array(q)

    change = (motion(u + small * w) - motion(u)) / small
    plant = Plant(*(np.array([[x]]) for x in (mass, damping, stiffness)), Force(np.eye(1)), ("displacement",))
    drive = u[:, None], u[:, None]

    def answered(value):
        terms = (Term(by_id("cubic_stiffness"), Place("y1", 0), np.array([value])),)
        laws = (terms[0].effect,)
        run = linearized(plant, np.zeros(2), *drive, slots_of(terms, plant, laws), h, laws=laws, substeps=8)
        return np.asarray(answers(run, np.ones(1), w[None], w[None], forced=True))[0, :, 0]

    left = {value: np.std(answered(value) - change) / np.std(change) for value in (k3, 0.0)}
    assert left[k3] < 0.02 and left[0.0] > 0.5
