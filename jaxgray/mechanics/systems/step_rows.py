"""The linear plant, and what one step of its simulation with added forces needs, as rows of a table."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .drives import ORDER, AbstractDrive
from .statespace import hold_matrices


class Plant(eqx.Module):
    """What a simulation needs of the linear part: matrices, drive, and what is measured.

    `mass`, `damping`, `stiffness` need not be symmetric (gyroscopic and circulatory terms).
    """

    mass: Float[Array, "dofs dofs"]
    damping: Float[Array, "dofs dofs"]
    stiffness: Float[Array, "dofs dofs"]
    drive: AbstractDrive
    measured: tuple[str, ...] = eqx.field(static=True)


def local_rows(
    plant: Plant, arms: Float[Array, "slots dofs"], time_unit
) -> tuple[Float[Array, "quantities slots states"], Float[Array, "quantities slots inputs"]]:
    """Displacement, velocity and acceleration along some arms from state (q, T q̇) and input, added forces left out."""
    dofs = plant.mass.shape[0]
    rows = [
        plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, (kind,) * dofs, time_unit) for kind in ORDER
    ]
    return jnp.stack([arms @ row.C for row in rows]), jnp.stack([arms @ row.D for row in rows])


class StepRows(eqx.Module):
    """What one step needs as rows of a table, so that a step is a few products: motion along the arms (displacement,
    velocity, acceleration) at the beginning, in the middle and at the end of the step, and the new state.

    `states`: by the state; `steady`, `rising`: by an input held, and by its rise over the step; last of all come the
    rates at which the velocities along the arms change at the beginning, which under a moving base are not the
    accelerations that a sensor sees. `halfway`, `ending`: motion in the middle and at the end by forces held from the
    beginning; `whole`: new state by such forces; `compliance`: acceleration along every arm by a unit force along
    every arm.
    """

    states: Float[Array, "rows states"]
    steady: Float[Array, "rows inputs"]
    rising: Float[Array, "rows inputs"]
    halfway: Float[Array, "motions slots"]
    ending: Float[Array, "motions slots"]
    whole: Float[Array, "states slots"]
    compliance: Float[Array, "slots slots"]

    @classmethod
    def of(cls, plant: Plant, arms: Float[Array, "slots dofs"], h) -> "StepRows":
        """The rows for steps of `h` [s] with forces along `arms`."""
        system = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, h)
        inputs, slots = system.B.shape[1], arms.shape[0]
        moved = jnp.linalg.solve(plant.mass, arms.T)
        pushes = -moved * h**2
        B = jnp.concatenate([system.B, jnp.concatenate([jnp.zeros_like(pushes), pushes])], axis=1)
        # The input and every force, held over a step, in one exponential each for the half and the whole step.
        Ad, B0, B1 = hold_matrices(system.A, B, 1.0, "linear")
        Ah, H0, H1 = hold_matrices(system.A, B, 0.5, "linear")
        C, D = (X.reshape(3 * slots, -1) for X in local_rows(plant, arms, h))
        rate, driven = C[slots : 2 * slots] @ system.A / h, C[slots : 2 * slots] @ system.B / h
        held, half = B0 + B1, H0 + H1
        late, late_half = B1[:, :inputs], H1[:, :inputs] / 2
        whole = held[:, inputs:]
        return cls(
            states=jnp.concatenate([C, C @ Ah, C @ Ad, Ad, rate]),
            steady=jnp.concatenate([D, C @ half[:, :inputs] + D, C @ held[:, :inputs] + D, held[:, :inputs], driven]),
            rising=jnp.concatenate([jnp.zeros_like(D), C @ late_half + D / 2, C @ late + D, late, 0.0 * driven]),
            halfway=C @ half[:, inputs:],
            ending=C @ whole,
            whole=whole,
            compliance=arms @ moved,
        )

    @property
    def yielding(self) -> Float[Array, "slots slots"]:
        """Velocity along every arm that a unit force along every arm takes back within the step."""
        slots = self.ending.shape[1]
        return -self.ending[slots : 2 * slots]

    def split(self, row):
        """Motion at the beginning, in the middle, at the end, each quantities × slots; the new state; and the rates of
        the velocities at the beginning. Samples last where there are many."""
        count, many, states = self.ending.shape[0], row.shape[1:], self.whole.shape[0]
        begin, middle, final = (row[k * count : (k + 1) * count].reshape(3, -1, *many) for k in range(3))
        return begin, middle, final, row[3 * count : 3 * count + states], row[3 * count + states :]
