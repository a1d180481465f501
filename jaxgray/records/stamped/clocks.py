"""Clocks that run beside that of the inputs: set otherwise, and faster or slower."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from .stamps import Stamps


@dataclass(frozen=True)
class ClockError:
    """How a clock stands to that of the inputs: true time = t + offset + rate (t − t₀), t₀ the start of the grid.

    `record`: position of the record among those of the fit; `clock`: its number; `outputs` that it times; `offset` [s]
    and `rate`, with their standard errors.
    """

    record: int
    clock: int
    outputs: tuple[str, ...]
    offset: float
    rate: float
    offset_error: float
    rate_error: float

    def sentence(self, step: float) -> str:
        """What is said of it. `step` of the grid [s]."""
        return (
            f"The clock of {', '.join(self.outputs)} is set {self.offset / step:+.3g} ± {self.offset_error / step:.1g} "
            f"samples off that of the inputs and runs {1e6 * self.rate:+.3g} ± {1e6 * self.rate_error:.1g} ppm slow: "
            "mended."
        )


def mended(stamps: Stamps, start: float, clock: int, offset: float, rate: float) -> Stamps:
    """Stamps with the times of one clock's rows mended."""
    time = stamps.time + np.where(stamps.clock == clock, offset + rate * (stamps.time - start), 0.0)
    return dataclasses.replace(stamps, time=time)
