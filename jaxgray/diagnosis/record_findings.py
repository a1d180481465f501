"""Findings of the raw record, and what its noise says of the experiment; they warn, and do not enter the verdict."""

import numpy as np

from ..identification.validation import residual_test
from ..records import Record, preflight
from .result import Estimate, Finding

WORTH = 20.0
"""Difference of likelihood (N ln det) from which noise at the forces is said."""

PLAUSIBLE = 1.0
"""Noise at the forces as large as the recorded ones: beyond, the colour of the noise is the better word."""

IDS = ("sensor_clipping", "sensor_quantization", "outliers", "dropped_samples")


def record_findings(record: Record, e: np.ndarray, ratio: float, worth: float) -> tuple[Finding, ...]:
    """Clipping, quantisation, outliers and gaps as findings of stage `record`; noise at the forces; feedback.

    **Arguments:** `record`; `e`: residual of the final model; `ratio` (ρ) of the force noise to the inputs' mean
    square; `worth`: by how much the likelihood is better with it.
    """
    found = []
    for finding in preflight(record):
        if finding.effect in IDS:
            values = {
                name: Estimate(float(value), None, "")
                for name, value in finding.values.items()
                if isinstance(value, (int, float)) and not isinstance(value, bool)
            }
            found.append(
                Finding(finding.effect, finding.location, "named", "record", (), values, None, None, finding.message)
            )
    if worth > WORTH and ratio <= PLAUSIBLE:
        message = "Noise enters at the forces too; error bars allow for it."
        values = {"ratio": Estimate(float(ratio), None, "")}
        found.append(Finding("process_noise", "record", "named", "record", (), values, None, None, message))
    if residual_test(np.where(np.isnan(record.y), np.nan, e[: record.samples]), record.u).feedback:
        message = "The residual is correlated with future inputs: the record may come from a closed loop."
        found.append(Finding("closed_loop", "record", "named", "record", (), {}, None, None, message))
    return tuple(found)
