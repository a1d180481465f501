"""Dry friction in a simulation: rest without creep, and several laws at one place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.mechanics.drives import Force
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.extended import Plant, plant_run, slots_of
from jaxgray.mechanics.tangents import Directions, run_and_tangents

COULOMB, STRIBECK = by_id("coulomb_friction"), by_id("stribeck_friction")
EPS, TIME = 1e-4, 0.01
FIRST = Place("y1", 0)


def plant():
    stiffness = np.array([[60.0, -20.0], [-20.0, 40.0]])
    return Plant(np.diag([1.0, 1.5]), 0.005 * stiffness, stiffness, Force(np.eye(2)), ("acceleration", "displacement"))


def pushes(samples=800):
    """Forces that move the first coordinate, with pauses in which friction holds it."""
    t = TIME * np.arange(samples)
    return np.stack([8.0 * np.sin(7.0 * t) * (np.sin(1.3 * t) > -0.2), 0.5 * np.sin(3.0 * t)], axis=1)


def run(*terms, substeps=4):
    laws = tuple(dict.fromkeys(term.effect for term in terms))
    u, x0 = jnp.asarray(pushes()), np.zeros(4)
    slots = slots_of(terms, plant(), laws)
    # By each term's Fc.
    along = np.zeros((len(terms), *slots.values.shape))
    along[np.arange(len(terms)), np.arange(len(terms)), 0] = 1.0
    zeros = [np.zeros((len(terms), *shape)) for shape in ((2, 2), (2, 2), (2, 2), (4,))]
    end = jnp.concatenate([u[1:], u[-1:]])
    y, J = jax.jit(
        lambda: run_and_tangents(
            plant(), x0, u, end, slots, Directions(*zeros, along), TIME, laws=laws, substeps=substeps, seen=u
        )
    )()
    return np.asarray(y), np.asarray(J)


def term(effect, *values, place=FIRST):
    return Term(effect, place, np.array([*values, EPS]))


@pytest.mark.parametrize("substeps", [1, 4, 16])
def test_two_dry_frictions_at_one_place_are_one_of_their_sum(substeps):
    y, J = run(term(COULOMB, 3.0), substeps=substeps)
    both, derivative = run(term(COULOMB, 1.0), term(COULOMB, 2.0), substeps=substeps)
    np.testing.assert_allclose(both, y, rtol=0, atol=1e-9 * np.abs(y).max())
    for k in range(2):
        np.testing.assert_allclose(derivative[:, :, k], J[:, :, 0], rtol=0, atol=1e-6 * np.abs(J).max())


def test_frictions_of_two_laws_at_one_place_have_bounded_derivatives():
    y, J = run(term(COULOMB, 3.0), substeps=16)
    both, derivative = run(term(COULOMB, 1.0), term(STRIBECK, 2.0, 2.0, 0.1), substeps=16)
    np.testing.assert_allclose(both, y, rtol=0, atol=1e-9 * np.abs(y).max())
    assert np.abs(derivative).max() < 2 * np.abs(J).max()


def test_frictions_at_neighbouring_places_have_bounded_derivatives():
    y, J = run(term(COULOMB, 3.0), term(COULOMB, 1.0, place=Place("y1-y2", 0, 1)), substeps=16)
    finer, other = run(term(COULOMB, 3.0), term(COULOMB, 1.0, place=Place("y1-y2", 0, 1)), substeps=64)
    assert np.sqrt(np.mean((y - finer)[:, 1] ** 2)) < 0.01 * np.sqrt(np.mean(finer[:, 1] ** 2))
    assert np.abs(J[:, 1]).max() < 2 * np.abs(other[:, 1]).max()


@pytest.mark.parametrize("effect, sizes", [(COULOMB, (3.0,)), (STRIBECK, (3.0, 3.0, 0.1))])
def test_a_body_that_friction_holds_creeps_less_in_shorter_steps(effect, sizes):
    """Held from rest by twice the force that pushes, over the whole record."""
    u = jnp.full((400, 2), jnp.array([1.5, 0.0]))
    crept = []
    laws = (effect,)
    still = Plant(np.eye(2), np.zeros((2, 2)), np.zeros((2, 2)), Force(np.eye(2)), ("displacement",) * 2)
    for substeps in (1, 8):
        slots = slots_of((Term(effect, FIRST, np.array([*sizes, 1.0])),), still, laws)
        y = plant_run(still, np.zeros(4), u, u, slots, TIME, laws=laws, substeps=substeps, seen=u)
        crept.append(abs(float(y[-1, 0])))
    assert crept[1] < crept[0] / 4 and crept[0] < 0.01 * TIME * 400
