"""Derivatives of a run with forces, beside derivatives through the run itself."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forces import FORCES, SAMPLES

from jaxgray.diagnosis.own_simulator.runs.numbers import over_time
from jaxgray.mechanics.effects.base import Term
from jaxgray.mechanics.runs.extended import Plant, plant_run, slots_of
from jaxgray.mechanics.runs.tangents import Directions, run_and_tangents
from jaxgray.mechanics.systems.drives import Force


@pytest.mark.parametrize(
    "forces, substeps",
    [("memory", 2)]
    + [
        pytest.param(*case, marks=pytest.mark.slow) for case in (("no memory", 3), ("no memory", 1), ("at an input", 1))
    ],
)
def test_derivatives_along_every_direction_are_those_through_the_run(forces, substeps):
    rng = np.random.default_rng(5)
    terms = FORCES[forces]
    laws = tuple(term.effect for term in terms)
    stiffness = np.array([[50.0, -20.0], [-20.0, 40.0]])
    plant = Plant(np.diag([1.0, 1.5]), 0.01 * stiffness, stiffness, Force(np.eye(2)), ("displacement", "acceleration"))
    slots = slots_of(terms, plant, laws)
    start, end, seen = jnp.asarray(rng.normal(size=(3, SAMPLES, 2)).cumsum(axis=1))
    x0, T = rng.normal(size=4), 0.02

    def moved(change):
        here = type(slots)(slots.law, slots.arms, slots.channel, slots.values + change.values)
        u = start + change.start, end + change.end
        more = {"laws": laws, "substeps": substeps, "seen": seen + change.seen}
        return plant_run(change.moved(plant), x0 + change.x0, *u, here, T, **more)

    shapes = (2, 2), (2, 2), (2, 2), (4,), slots.values.shape, *((SAMPLES, 2),) * 3
    along = Directions(*(rng.normal(size=(7, *shape)) for shape in shapes))
    # As refits ask for them: inputs stay as they are.
    still = Directions(*(rng.normal(size=(7, *shape)) for shape in shapes[:5]))
    zeros = Directions(*(np.zeros(shape) for shape in shapes))
    through = jax.jit(jax.vmap(lambda one: jax.jvp(moved, (zeros,), (one,)), out_axes=(None, -1)))

    @jax.jit
    def run(one):
        more = {"laws": laws, "substeps": jnp.asarray(substeps), "seen": seen}
        return run_and_tangents(plant, x0, start, end, slots, one, T, **more)

    for directions in (along, still):
        filled = Directions(
            *(np.zeros((7, *shape)) if own is None else own for own, shape in zip(vars(directions).values(), shapes))
        )
        (clean, wanted), (y, J) = through(filled), run(directions)
        np.testing.assert_allclose(y, clean, rtol=1e-9, atol=1e-9 * np.abs(y).max())
        assert J.shape == (SAMPLES, 2, 7)
        np.testing.assert_allclose(J, wanted, rtol=1e-8, atol=1e-10 * np.abs(wanted).max())
        assert np.abs(wanted[:, 0]).max() > 1e-3 and np.abs(wanted[:, 1]).max() > 1e-3


def test_stiffness_and_damping_that_are_inputs_act_as_laws_of_the_same_force():
    rng = np.random.default_rng(6)
    stiffness = np.array([[50.0, -20.0], [-20.0, 40.0]])
    known = np.eye(2)
    E = np.concatenate([known, known, known], axis=1)
    plant = Plant(np.diag([1.0, 1.5]), 0.01 * stiffness, stiffness, Force(E), ("displacement", "acceleration"))
    spring = FORCES["memory"][1:]
    elements = over_time(2, 2)
    as_laws = {type(t.effect): type("AsLaw", (type(t.effect),), {"element": ""})() for t in elements}
    plain = tuple(Term(as_laws[type(t.effect)], t.place, t.values) for t in elements)
    start, end = jnp.asarray(rng.normal(size=(2, 60, 6)))
    x0, zero, first = rng.normal(size=4), np.zeros((6, 2, 2)), rng.normal(size=(6, 4))
    made = []
    for beside in ((), spring):
        for terms in (elements, plain):
            laws = tuple(dict.fromkeys(t.effect for t in (*beside, *terms) if not t.effect.element))
            slots = slots_of((*terms, *beside), plant, laws)
            assert len(slots.law) == len(beside) + (0 if terms is elements else 4)
            assert len(slots.arms) == len(beside) + (2 if terms is elements else 4)
            along = Directions(zero, zero, zero, first, np.zeros((6, *slots.values.shape)))
            run = jax.jit(functools.partial(run_and_tangents, laws=laws))
            made.append(run(plant, x0, start, end, slots, along, 0.02, substeps=jnp.asarray(2)))
    for one, other in (made[:2], made[2:]):
        for X, Y in zip(one, other):
            np.testing.assert_allclose(X, Y, rtol=1e-9, atol=1e-11 * np.abs(Y).max())
    assert np.abs(made[0][0] - made[2][0]).max() > 1e-3 * np.abs(made[0][0]).max()
