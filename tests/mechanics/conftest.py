"""One two-coordinate system, so that what is compiled once serves every test."""

import numpy as np
import pytest

from jaxgray.mechanics.model import MechanicalModel

M = np.array([[5.0, -1.0], [-1.0, 1.0]])
D = np.array([[5.0, -0.01], [-0.01, 1.0]])
K = np.array([[100.0, -5.0], [-5.0, 100.0]])


@pytest.fixture(scope="session")
def matrices():
    """Mass, damping and stiffness as plain arrays."""
    return M, D, K


@pytest.fixture(scope="session")
def model():
    """The system with a force on each coordinate, both displacements measured."""
    return MechanicalModel(M, D, K)


@pytest.fixture(scope="session")
def covariance():
    """A full covariance of the nine entries, about 0.5 % each."""
    rng = np.random.default_rng(3)
    upper = np.triu_indices(2)
    size = np.concatenate([np.abs(X.T[upper[::-1]]) for X in (M, D, K)])
    mixing = np.eye(9) + 0.3 * rng.standard_normal((9, 9))
    root = 0.005 * np.maximum(size, 0.05)[:, None] * mixing
    return root @ root.T
