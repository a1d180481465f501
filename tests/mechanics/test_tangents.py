"""Derivatives of a run with forces, beside derivatives through the run itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.runs.extended import Plant, plant_run, slots_of
from jaxgray.mechanics.runs.tangents import CHUNK, Directions, run_and_tangents
from jaxgray.mechanics.systems.drives import Force

SAMPLES = CHUNK + 44
FORCES = {
    "no memory": (Term(by_id("coulomb_friction"), Place("y1", 0), np.array([0.4, 0.05])),),
    "memory": (
        Term(by_id("dahl_friction"), Place("y1-y2", 0, 1), np.array([0.5, 0.1])),
        Term(by_id("cubic_stiffness"), Place("y2", 1), np.array([30.0])),
    ),
    "at an input": (Term(by_id("input_position_gain"), Place("u1", 0), np.array([0.3, 0.1])),),
}


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
