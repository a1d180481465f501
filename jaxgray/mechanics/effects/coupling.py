"""Entries of M, D, K: those that a symmetric model cannot have, and errors of a model that was given."""

import jax.numpy as jnp
import numpy as np

from .base import AbstractMatrixEffect, Parameter


def _skew(first, second):
    return jnp.outer(first, second) - jnp.outer(second, first)


def _entry(first, second):
    """1 at the diagonal entry of `first`, or at both off-diagonal entries of a pair."""
    alone = 1.0 - second @ second
    return alone * jnp.outer(first, first) + jnp.outer(first, second) + jnp.outer(second, first)


class GyroscopicCoupling(AbstractMatrixEffect):
    """Force on one coordinate from the velocity of the other, without dissipation: spinning parts."""

    id = "gyroscopic_coupling"
    family = "coupling"
    law = "damping[i, j] += g, damping[j, i] −= g"
    parameters = (Parameter("g", (1, -1, 1), amplitude=True),)
    parity = "odd"
    signature = "phase of ±90° between two axes"
    reference = "Meirovitch, Methods of Analytical Dynamics, McGraw-Hill 1970"
    places = "pair"

    def shapes(self, scales):
        return [np.array([1.0])]

    def matrices(self, p, M, D, K, first, second):
        return M, D + p[0] * _skew(first, second), K


class CirculatoryCoupling(AbstractMatrixEffect):
    """Unequal static cross terms: follower forces, seals, journal bearings, feedback."""

    id = "circulatory_coupling"
    family = "coupling"
    law = "stiffness[i, j] += kc, stiffness[j, i] −= kc"
    parameters = (Parameter("kc", (1, -1, 0), amplitude=True),)
    parity = "odd"
    signature = "unequal static cross terms"
    reference = "Ziegler, Principles of Structural Stability, Blaisdell 1968"
    places = "pair"

    def shapes(self, scales):
        return [np.array([1.0])]

    def matrices(self, p, M, D, K, first, second):
        return M, D, K + p[0] * _skew(first, second)


class MassError(AbstractMatrixEffect):
    """Wrong entry of the mass matrix that was given."""

    id = "mass_error"
    family = "coupling"
    law = "mass entry += delta, symmetric"
    parameters = (Parameter("delta", (1, -1, 2), amplitude=True),)
    parity = "odd"
    signature = "residual in phase with the acceleration"
    reference = "Mottershead & Friswell, J. Sound Vib. 167 (1993) 347-375"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0])]

    def matrices(self, p, M, D, K, first, second):
        return M + p[0] * _entry(first, second), D, K


class DampingError(AbstractMatrixEffect):
    """Wrong entry of the damping matrix that was given."""

    id = "damping_error"
    family = "coupling"
    law = "damping entry += delta, symmetric"
    parameters = (Parameter("delta", (1, -1, 1), amplitude=True),)
    parity = "odd"
    signature = "residual in phase with the velocity"
    reference = "Mottershead & Friswell, J. Sound Vib. 167 (1993) 347-375"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0])]

    def matrices(self, p, M, D, K, first, second):
        return M, D + p[0] * _entry(first, second), K


class StiffnessError(AbstractMatrixEffect):
    """Wrong entry of the stiffness matrix that was given."""

    id = "stiffness_error"
    family = "coupling"
    law = "stiffness entry += delta, symmetric"
    parameters = (Parameter("delta", (1, -1, 0), amplitude=True),)
    parity = "odd"
    signature = "residual in phase with the displacement"
    reference = "Mottershead & Friswell, J. Sound Vib. 167 (1993) 347-375"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0])]

    def matrices(self, p, M, D, K, first, second):
        return M, D, K + p[0] * _entry(first, second)
