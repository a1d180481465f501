"""Thresholds that several rooms of the diagnosis share."""

from ..mechanics.effects.stiffness import DeadZoneStiffness, EndStop

MIN_DELTA_BIC = 10.0
"""ΔBIC of a refit from which it is believed."""

CLASS_DELTA_BIC = 6.0
"""Difference of BIC within which two refits count as one class."""

MIN_STANDARD_ERRORS = 4.0
"""|β|/se from which an amplitude counts."""

GATE_DELTA_BIC = 10.0
"""ΔBIC from which a candidate counts."""

SIGNIFICANCE = 0.01
"""Family-wise probability of a false alarm (Holm)."""

MAX_CRITERION_GAP = 100.0
"""Distance in criterion from the best first refit beyond which a candidate is not pursued; its refit is given up at
twice this."""

LOOK_ALIKE_DELTA_BIC = 10.0
"""Difference of BIC within which two laws that are easily alike count as one class."""

CONTACT = frozenset({DeadZoneStiffness.id, EndStop.id})
"""Laws that differ in their name alone, by how much of the record is spent in contact."""

MIN_EXPLAINED_SHARE = 0.1
"""Least share of what is left above the noise that a finding must explain."""

MIN_STANDARD_ERRORS_IF_CLEAR = 2.0
"""|β|/se that is enough where ΔBIC is beyond `CLEAR_DELTA_BIC`."""

CLEAR_DELTA_BIC = 100.0
"""ΔBIC from which something is there, whatever the noise."""
