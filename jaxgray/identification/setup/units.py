"""Units in which a record is fitted: every channel of unit size, time in samples."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import ORDER


class Scaling(eqx.Module):
    """Units in which every channel has unit size and time is counted in samples.

    `inputs`, `outputs`: size of each channel; `coordinates`: the size of each displacement that goes with
    its output; `sampling_time` [s].
    """

    inputs: Float[Array, " inputs"]
    outputs: Float[Array, " outputs"]
    coordinates: Float[Array, " dofs"]
    sampling_time: float

    @classmethod
    def of(cls, inputs, outputs, sampling_time, measured) -> "Scaling":
        """Scaling from the sizes of the channels and what the outputs measure."""
        order = np.array([ORDER[kind] for kind in measured])
        # A plain number would be compiled in.
        sampling_time = np.float64(sampling_time) if isinstance(sampling_time, float) else sampling_time
        return cls(inputs, outputs, outputs * sampling_time**order, sampling_time)

    def input_map(self, E: Float[Array, "dofs inputs"]) -> Float[Array, "dofs inputs"]:
        """E in scaled coordinates."""
        return self.coordinates[:, None] * E * self.inputs[None, :]

    def matrices_in(self, M: Array, D: Array, K: Array) -> tuple[Array, Array, Array]:
        """M, D, K in scaled coordinates."""
        outer = self.coordinates[:, None] * self.coordinates[None, :]
        return M * outer / self.sampling_time**2, D * outer / self.sampling_time, K * outer

    def matrices_out(self, M: Array, D: Array, K: Array) -> tuple[Array, Array, Array]:
        """M, D, K in the record's units."""
        outer = self.coordinates[:, None] * self.coordinates[None, :]
        return M / outer * self.sampling_time**2, D / outer * self.sampling_time, K / outer
