"""Which way dry friction acts while bodies slide, reverse and rest: solved for all places of a step at once.

Over a step the velocity along an arm would run in a straight line from a to `free` without friction; friction of full
size takes k of it back. For a > 0 it slides on, s = 1, where free > k. Otherwise it comes to rest after the part θ of
the step, and then stays there, held, or goes back:

    θ = a/(a + k − free),        s = θ + (1 − θ) g/k  for |g| ≤ k,  2θ − 1 for g < −k,        g = free − a,

s being the mean direction. So reversals are neither missed nor overshot, and a body at rest stays there. Where the law
turns over a width that the steps resolve, s is the mean over the step of v/width limited to ±1. Several places are
solved in turn (Gauss-Seidel), with one Newton step of all at the end; its derivative is that of this step.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.friction import SLOWEST, ratio

SHARP = 10.0
"""Velocity that a friction takes back in a step, in widths of its turn, from which it counts as sharp."""

AT_REST = 4.0
"""Velocity below which a body is at rest, in widths: a step may end a little beyond one."""

TURNS = 4
"""Times that the places are solved one after the other at most."""

STAYS = 1e-9
"""Change of a direction that counts as none."""

SHARED = 1e-12
"""Added to the diagonal, relative, so that a solution exists where places that depend on one another share a force."""


class Rubbing(eqx.Module):
    """Dry friction at some places; laws at one place turn together, as one of the size of their sum.

    `size` of each; `width`: velocity over which it turns; `together`: 1 where two stand at one place, a place with
    itself too. Samples last where there are many.
    """

    size: Float[Array, "slots *samples"]
    width: Float[Array, "slots *samples"]
    together: Float[Array, "slots slots"]

    @classmethod
    def of(cls, size, width, arms: Float[Array, "slots dofs"]) -> "Rubbing":
        """From the sizes and widths that laws have, along some arms."""
        together = jnp.all(arms[:, None] == arms[None], axis=2).astype(float)
        # Where nothing rubs any width does.
        return cls(jnp.maximum(size, 0.0), jnp.where(size > 0, jnp.maximum(width, SLOWEST), 1.0), together)

    def at_an_instant(self, v, a, compliance: Float[Array, "slots slots"]) -> Float[Array, "slots *samples"]:
        """Forces at velocity `v`, in the direction of v/width limited to ±1. Where bodies are at rest and friction can
        hold them, they are what holds, `a` being the rates of the velocities without them: the velocity there is
        rounding, and an accelerometer sees the force."""
        return self._where_some_rub(Rubbing._at_an_instant, v, a, compliance)

    def over_a_step(self, v, free, yielding: Float[Array, "slots slots"]) -> Float[Array, "slots *samples"]:
        """Mean forces over a step that begins at velocity `v` and would end at `free` without friction."""
        return self._where_some_rub(Rubbing._over_a_step, v, free, yielding)

    def _where_some_rub(self, turn, *given):
        return jax.lax.cond(
            jnp.any(self.size > 0), lambda own, *x: own.size * turn(own, *x), lambda own, *x: 0.0 * x[0], self, *given
        )

    def _at_an_instant(self, v, a, compliance):
        rest = (jnp.abs(v) < AT_REST * self.width) & (self.size > 0)
        # A turn over no width at all has no slope.
        sliding = jnp.where(self.width > SLOWEST, jnp.clip(v / self.width, -1.0, 1.0), jnp.sign(v))
        own, others = self._coupling(compliance)
        turn = _holding_or_sliding(jnp.zeros_like(a), rest, sliding, a, own, others)
        if len(v) == 1:
            return turn
        turn = _one_after_the_other(_holding_or_sliding, turn, rest, sliding, a, own, others)
        held = rest & (jnp.abs(ratio(a - _times(others, turn), own)) < 1.0)
        missing = jnp.where(held, a - own * turn - _times(others, turn), sliding - turn)
        # Places that hold one another, as in a ring, leave open who holds what.
        A = jnp.where(held[:, None], (1.0 + SHARED) * _diagonal(own) + others, _diagonal(jnp.ones_like(own)))
        return jnp.clip(turn + _times(_inverse(A), missing), -1.0, 1.0)

    def _over_a_step(self, v, free, yielding):
        own, others = self._coupling(yielding)
        if len(v) == 1:
            return _mean_direction(v, free, own, self.width)[0]
        turn = _one_after_the_other(_over_a_step, jnp.zeros_like(free), v, free, own, self.width, others)
        mean, slope = _mean_direction(v, free - _times(others, turn), own, self.width)
        A = (1.0 + SHARED) * _diagonal(jnp.ones_like(own)) + slope[:, None] * others
        return jnp.clip(turn + _times(_inverse(A), mean - turn), -1.0, 1.0)

    def _coupling(self, response: Float[Array, "slots slots"]):
        """What all friction of a place does there, and what that of other places does, by the response to forces."""
        own = _widened(jnp.diag(response), self.size) * _times(self.together, self.size)
        others = _widened(response * (1.0 - self.together), self.size) * self.size[None]
        return own, jnp.where((self.size > 0)[:, None], others, 0.0)


def _holding_or_sliding(turn, rest, sliding, a, own, others):
    wanted = ratio(a - _times(others, turn), own)
    return jnp.where(rest & (jnp.abs(wanted) < 1.0), wanted, sliding)


def _over_a_step(turn, v, free, own, width, others):
    return _mean_direction(v, free - _times(others, turn), own, width)[0]


def _one_after_the_other(direction, turn, *given):
    """Directions, solved in turn with the others as they then stand, until they stay; at once where nothing rubs at
    two places."""
    turn, *given = jax.lax.stop_gradient((turn, *given))
    places = jnp.arange(len(turn)).reshape(-1, *(1,) * (turn.ndim - 1))

    def moves(state):
        k, turn, before = state
        return (k < TURNS) & jnp.any(jnp.abs(turn - before) > STAYS)

    def once(state):
        def solve(place, turn):
            return jnp.where(places == place, direction(turn, *given), turn)

        k, turn, _ = state
        return k + 1, jax.lax.fori_loop(0, len(turn), solve, turn), turn

    coupled = jnp.any(given[-1] != 0.0)
    return jax.lax.while_loop(moves, once, (0, turn, jnp.where(coupled, jnp.inf, turn)))[1]


def _mean_direction(v, free, k, width):
    """Mean direction over a step, and its derivative by `free`; see the module."""
    sharp, by_free = _of_a_sharp_turn(v, free, jnp.where(k > 0, k, 1.0))
    first, free, k = v / width, free / width, k / width
    b = _end_of_a_wide_turn(*(jax.lax.stop_gradient(x) for x in (first, free, k)))
    mean, slope = _mean_sign(first, b)
    b = b + (free - b - k * mean) / (1.0 + jax.lax.stop_gradient(k * slope))
    resolved = jax.lax.stop_gradient(k < SHARP)
    direction = jnp.where(resolved, _mean_sign(first, b)[0], sharp)
    return direction, jax.lax.stop_gradient(jnp.where(resolved, slope / (1.0 + k * slope) / width, by_free))


def _of_a_sharp_turn(a, free, k):
    way = jnp.where(a == 0, jnp.sign(free), jnp.sign(a))
    a, free = way * a, way * free
    slides, left = free > k, jnp.where(free > k, 1.0, jnp.maximum(a + k - free, SLOWEST))
    part, g = a / left, free - a
    held = jnp.abs(g) <= k
    mean = jnp.where(slides, 1.0, jnp.where(held, part + (1.0 - part) * g / k, 2.0 * part - 1.0))
    slope = jnp.where(held, part / left * (1.0 - g / k) + (1.0 - part) / k, 2.0 * part / left)
    return way * mean, jnp.where(slides, 0.0, slope)


def _end_of_a_wide_turn(a, f, k):
    """End b of a step that begins at a: f − b = k·(mean sign over [a, b]).

    (f − b)(b − a) = k (G(b) − G(a)) is a quadratic in b above 1, below −1 and between; the mean rises with b, so that
    the piece with the solution shows at ±1.
    """
    Ga = _ramp(a)

    def beyond(b):
        return f - b - k * _mean_sign(a, jnp.full_like(f, b))[0]

    def root(A, B, C, larger):
        # A b² + B b + C = 0 without cancellation.
        q = -(B + jnp.where(B < 0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(B * B - 4 * A * C, 0.0))) / 2
        one, other = q / A, C / jnp.where(q == 0, 1.0, q)
        return jnp.where(larger, jnp.maximum(one, other), jnp.minimum(one, other))

    above = jnp.where(a >= 1, f - k, root(1.0, k - f - a, f * a - k * (0.5 + Ga), True))
    below = jnp.where(a <= -1, f + k, root(1.0, -(f + a + k), f * a - k * (0.5 + Ga), False))
    across = root(1 + k / 2, -(f + a), f * a - k * Ga, a < 0)
    within = jnp.where(jnp.abs(a) <= 1, (f - k * a / 2) / (1 + k / 2), across)
    return jnp.where(beyond(1.0) > 0, above, jnp.where(beyond(-1.0) < 0, below, within))


def _mean_sign(a, b):
    """Mean of x limited to ±1 over [a, b], and its derivative by b."""
    near = jnp.abs(b - a) < 1e-3
    distance = jnp.where(near, 1.0, b - a)
    sign = jnp.clip(b, -1.0, 1.0)
    mean = jnp.where(near, jnp.clip((a + b) / 2, -1.0, 1.0), (_ramp(b) - _ramp(a)) / distance)
    slope = jnp.where(near, (jnp.abs(b) < 1.0) / 2.0, (sign - mean) / distance)
    return mean, jnp.maximum(slope, 0.0)


def _ramp(x):
    size = jnp.abs(x)
    return jnp.where(size < 1.0, x * x / 2, size - 0.5)


def _widened(X, like):
    """With a last axis of one more where samples stand last in another array."""
    return X[..., None] if jnp.ndim(like) > 1 else X


def _times(A, x):
    """A x, samples last, as sums that the compiler fuses."""
    A = A if jnp.ndim(A) > jnp.ndim(x) else _widened(A, x)
    return sum(A[:, k] * x[k] for k in range(A.shape[1]))


def _diagonal(x):
    return _widened(jnp.eye(len(x)), x) * x[None]


def _inverse(A):
    """Inverse at every sample, by elimination; no pivots: A is the unit matrix and a product of two that are positive.
    Its derivative is left out."""
    A = jax.lax.stop_gradient(A)
    unit = jnp.broadcast_to(_widened(jnp.eye(len(A)), A[0]), A.shape)
    rows = jnp.concatenate([A, unit], axis=1)
    for k in range(len(A)):
        rows = rows - (rows[:, k] - unit[:, k])[:, None] * (rows[k] / rows[k, k])[None]
    return rows[:, len(A) :]
