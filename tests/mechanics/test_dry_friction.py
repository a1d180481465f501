"""Dry friction in a simulation: reversals, rest, and laws at several places."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.runs.extended import Plant, plant_run, slots_of
from jaxgray.mechanics.runs.tangents import Directions, run_and_tangents
from jaxgray.mechanics.systems.drives import Force

COULOMB, STRIBECK = by_id("coulomb_friction"), by_id("stribeck_friction")
EPS, TIME = 1e-4, 0.01
STIFF = 41.0
FIRST = Place("y1", 0)


def plant():
    stiffness = np.array([[60.0, -20.0], [-20.0, 40.0]])
    return Plant(np.diag([1.0, 1.5]), 0.005 * stiffness, stiffness, Force(np.eye(2)), ("acceleration", "displacement"))


def pushes(samples=800):
    """Forces that move the first coordinate, with pauses in which friction holds it."""
    t = TIME * np.arange(samples)
    return np.stack([8.0 * np.sin(7.0 * t) * (np.sin(1.3 * t) > -0.2), 0.5 * np.sin(3.0 * t)], axis=1)


def run(*terms, substeps=4):
    u, x0, laws = jnp.asarray(pushes()), np.zeros(4), (COULOMB, STRIBECK)
    slots = slots_of(terms, plant(), laws)
    # By each term's Fc.
    along = np.zeros((len(terms), *slots.values.shape))
    along[np.arange(len(terms)), np.arange(len(terms)), 0] = 1.0
    zeros = [np.zeros((len(terms), *shape)) for shape in ((2, 2), (2, 2), (2, 2), (4,))]
    end = jnp.concatenate([u[1:], u[-1:]])
    # As an array, so that one program serves any number of steps.
    y, J = differentiated(plant(), x0, u, end, slots, Directions(*zeros, along), laws, np.asarray(substeps))
    return np.asarray(y), np.asarray(J)


@eqx.filter_jit
def differentiated(plant, x0, u, end, slots, along, laws, substeps):
    return run_and_tangents(plant, x0, u, end, slots, along, TIME, laws=laws, substeps=substeps, seen=u)


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


@pytest.mark.parametrize(
    "terms",
    [
        (term(COULOMB, 3.0), Term(by_id("cubic_stiffness"), Place("y1-y2", 0, 1), np.array([50.0]))),
        # Each of three holds part of what the other two could hold.
        (term(COULOMB, 3.0), term(COULOMB, 2.0, place=Place("y2", 1)), term(COULOMB, 1.0, place=Place("y1-y2", 0, 1))),
    ],
)
def test_all_is_still_without_a_force_and_finite_with_one(terms):
    laws = tuple(dict.fromkeys(one.effect for one in terms))
    slots = slots_of(terms, plant(), laws)
    along = np.zeros((1, *slots.values.shape))
    along[0, 0, 0] = 1.0
    zeros = [np.zeros((1, *shape)) for shape in ((2, 2), (2, 2), (2, 2), (4,))]

    def moved(u):
        directions = Directions(*zeros, along)
        return run_and_tangents(plant(), np.zeros(4), u, u, slots, directions, TIME, laws=laws, substeps=4, seen=u)

    y, J = jax.jit(moved)(jnp.zeros((300, 2)))
    assert np.all(np.asarray(y) == 0) and np.all(np.asarray(J) == 0)
    y, J = jax.jit(moved)(jnp.asarray(pushes(300)))
    assert np.all(np.isfinite(y)) and np.all(np.isfinite(J)) and np.abs(J).max() < 10


def single(effect, values, x0, *, push=0.0, stiffness=STIFF, substeps=1, samples=600):
    """Displacement of a mass of 1 kg on a spring under a constant force and friction."""
    plant = Plant(np.eye(1), np.zeros((1, 1)), np.full((1, 1), stiffness), Force(np.eye(1)), ("displacement",))
    u = jnp.full((samples, 1), push)
    slots = slots_of((Term(effect, FIRST, np.array(values)),), plant, (effect,))
    return np.asarray(plant_run(plant, x0, u, u, slots, 0.02, laws=(effect,), substeps=substeps, seen=u))[:, 0]


def swings(t, start, friction):
    """A mass of 1 kg on a spring, let go, under dry friction: half swings about ± friction/stiffness, then rest."""
    omega, shift = np.sqrt(STIFF), friction / STIFF
    half = np.floor(t * omega / np.pi).astype(int)
    stays = int(np.ceil((start - shift) / (2 * shift)))
    half = np.minimum(half, stays)
    turn = (-1.0) ** half * (start - 2 * shift * half)
    moving = (turn - np.sign(turn) * shift) * np.cos(omega * t - np.pi * half) + np.sign(turn) * shift
    return np.where(half == stays, turn, moving)


def test_dry_friction_is_followed_to_second_order_until_the_body_sticks():
    wanted = swings(0.02 * np.arange(600), 1.0, 2.0)
    assert np.ptp(wanted[-200:]) == 0.0 and abs(wanted[-1]) < 2.0 / STIFF
    off = [
        np.sqrt(np.mean((single(COULOMB, [2.0, 1e-7], np.array([1.0, 0.0]), substeps=n) - wanted) ** 2)) for n in (2, 8)
    ]
    assert off[0] < 3e-3 and off[1] < off[0] / 12


@pytest.mark.parametrize("effect, sizes", [(COULOMB, (3.0,)), (STRIBECK, (3.0, 3.0, 0.1))])
@pytest.mark.parametrize("substeps", [1, 8])
def test_a_body_that_friction_holds_stays(effect, sizes, substeps):
    held = single(effect, [*sizes, 1e-7], np.zeros(2), push=1.5, stiffness=0.0, substeps=substeps)
    assert np.abs(held).max() < 1e-12


def test_a_turn_that_the_steps_resolve_is_that_of_the_law():
    def rates(_, x):
        return [x[1], -STIFF * x[0] - 2.0 * np.clip(x[1] / 0.5, -1.0, 1.0)]

    t = 0.02 * np.arange(300)
    wanted = scipy.integrate.solve_ivp(rates, (0, t[-1]), [1.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12, max_step=0.01)
    found = single(COULOMB, [2.0, 0.5], np.array([1.0, 0.0]), substeps=4, samples=300)
    np.testing.assert_allclose(found, wanted.y[0], rtol=0, atol=1e-3)
