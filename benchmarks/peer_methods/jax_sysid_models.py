"""jax-sysid: a free linear model, and the gray box with a Runge-Kutta step as its state function."""

import importlib.metadata

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax_sysid.models import LinearModel, Model  # noqa: E402
from physical import ENTRIES, GUESS, physical  # noqa: E402

VERSION = f"jax-sysid {importlib.metadata.version('jax-sysid')} (jax {jax.__version__})"
ADAM, EPOCHS = 500, 2000


def linear(u, y, h):
    """Adam, then L-BFGS, as the package's own linear examples do; scaled data."""
    size_u, size_y = u.std(axis=0), y.std(axis=0)
    model = LinearModel(4, 2, 2, feedthrough=False, sigma=0.9, seed=0)
    model.loss(rho_x0=1e-9, rho_th=1e-9)
    model.optimization(adam_epochs=ADAM, lbfgs_epochs=EPOCHS, iprint=-1)
    model.fit(y / size_y, u / size_u)
    A, B, C, _ = (np.asarray(X) for X in model.ssdata())
    return physical(A, B / size_u, C * size_y[:, None], h), f"{ADAM} Adam and at most {EPOCHS} L-BFGS steps"


def gray_box(u, y, h):
    """Cholesky factors of M, D and K, the first state and offsets; Adam, then L-BFGS."""
    scale = jnp.repeat(jnp.array([np.sqrt(np.max(np.abs(X))) for X in GUESS]), 3)
    size = y.std(axis=0)

    def matrices(theta):
        lower = [jnp.array([[a, 0.0], [b, c]]) for a, b, c in (theta * scale).reshape(3, 3)]
        return [L @ L.T for L in lower]

    def rate(x, force, m, d, k):
        rest = force - d @ x[2:] - k @ x[:2]
        determinant = m[0, 0] * m[1, 1] - m[0, 1] ** 2
        solved = jnp.array([m[1, 1] * rest[0] - m[0, 1] * rest[1], m[0, 0] * rest[1] - m[0, 1] * rest[0]])
        return jnp.concatenate([x[2:], solved / determinant])

    @jax.jit
    def step(x, force, parameters):
        mdk = matrices(parameters[0])
        a = rate(x, force, *mdk)
        b = rate(x + h / 2 * a, force, *mdk)
        c = rate(x + h / 2 * b, force, *mdk)
        d = rate(x + h * c, force, *mdk)
        return x + h / 6 * (a + 2 * b + 2 * c + d)

    @jax.jit
    def output(x, force, parameters):
        return x[:2] / size + parameters[1]

    start = np.concatenate([[np.linalg.cholesky(X)[k[::-1]] for k in ENTRIES] for X in GUESS])
    model = Model(4, 2, 2, state_fcn=step, output_fcn=output)
    model.init(params=[jnp.asarray(start) / scale, jnp.zeros(2)], x0=jnp.zeros(4))
    model.loss(rho_x0=0.0, rho_th=0.0)
    model.optimization(adam_epochs=ADAM, adam_eta=3e-3, lbfgs_epochs=EPOCHS, iprint=-1, lbfgs_tol=1e-14)
    model.fit(y / size, u)
    return [np.asarray(X) for X in matrices(model.params[0])], f"{ADAM} Adam and at most {EPOCHS} L-BFGS steps"


METHODS = {"jax-sysid": linear, "jax-sysid-gray-box": gray_box}
