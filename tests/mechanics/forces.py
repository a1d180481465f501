"""Laws of two coordinates whose runs are differentiated: without memory, with memory, and one that sees an input."""

import numpy as np

from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.runs.tangents import CHUNK

SAMPLES = CHUNK + 44
FORCES = {
    "no memory": (Term(by_id("coulomb_friction"), Place("y1", 0), np.array([0.4, 0.05])),),
    "memory": (
        Term(by_id("dahl_friction"), Place("y1-y2", 0, 1), np.array([0.5, 0.1])),
        Term(by_id("cubic_stiffness"), Place("y2", 1), np.array([30.0])),
    ),
    "at an input": (Term(by_id("input_position_gain"), Place("u1", 0), np.array([0.3, 0.1])),),
}
