"""What the adapters share: inputs over the steps of a sample, and names in a message."""

import numpy as np
from jaxtyping import Float

FEW_NAMES = 12
"""Names that a message lists."""


def held(
    forces: Float[np.ndarray, "samples inputs"], steps: int, hold: str
) -> Float[np.ndarray, "samples*steps inputs"]:
    """Inputs at every step of a sample: held over it, or the means of a straight line to the next one."""
    if hold != "linear":
        return np.repeat(forces, steps, axis=0)
    after = np.concatenate([forces[1:], forces[-1:]])
    share = ((np.arange(steps) + 0.5) / steps)[None, :, None]
    return (forces[:, None] * (1 - share) + after[:, None] * share).reshape(-1, forces.shape[1])


def named(names) -> str:
    """The first names of a list, with commas."""
    names = list(names)
    return ", ".join(names[:FEW_NAMES]) + (", …" if len(names) > FEW_NAMES else "")
