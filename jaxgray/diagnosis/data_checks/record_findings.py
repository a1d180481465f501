"""Findings of the raw record, and what its noise says of the experiment; they warn, and do not enter the verdict."""

import numpy as np

from ...identification.validation.residuals import residual_test
from ...records import Record, preflight
from .. import settings
from ..findings import Estimate, Finding
from ..noise.whitening import NoiseModel

SAID = 1.1
"""Free run over prediction, root mean squares, from which the difference is said."""

IDS = ("sensor_clipping", "sensor_quantization", "outliers", "dropped_samples")
LEFT_OUT = ("sensor_clipping", "outliers", "dropped_samples")


def record_findings(measured: Record) -> tuple[Finding, ...]:
    """Clipping, quantisation, outliers and gaps, as findings of stage `record`.

    **Arguments:** `measured`: the record as it came, before its spoilt samples were made missing.
    """
    found = []
    for finding in preflight(measured, relations=False):
        if finding.effect in IDS:
            values = {
                name: Estimate(float(value), None, "")
                for name, value in finding.values.items()
                if isinstance(value, (int, float)) and not isinstance(value, bool)
            }
            text = finding.message
            # What is missing is left out anyway, and its message says so.
            if finding.effect in LEFT_OUT and "gaps" not in finding.values:
                text += " The diagnosis leaves these samples out."
            found.append(Finding(finding.effect, finding.location, "named", "record", (), values, None, None, text))
    return tuple(found)


def still_spoilt(cleaned: Record) -> bool:
    """Whether so much of a record is clipped, or far off, that it was not taken away."""
    return any(finding.effect in LEFT_OUT for finding in preflight(cleaned, relations=False))


def noise_findings(used: Record, e: np.ndarray, noise_model: NoiseModel | None = None) -> tuple[Finding, ...]:
    """Noise at the forces and feedback, as findings of stage `record`.

    **Arguments:** `used`: the record without its spoilt samples; `e`: residual of the final model; `noise_model` that
    was estimated from it, None where none was.
    """
    found = []
    if (
        noise_model is not None
        and noise_model.worth > settings.MIN_DELTA_BIC
        and noise_model.ratio <= settings.MAX_FORCE_NOISE
    ):
        further = float(np.max(noise_model.level / np.diag(noise_model.lower)))
        message = "Noise enters at the forces too; error bars allow for it."
        if further >= SAID:
            message += (
                f" The free run leaves {further:.1f} times what a prediction one step ahead leaves; a law that is not "
                "in the catalogue can look the same."
            )
        values = {"ratio": Estimate(float(noise_model.ratio), None, "")}
        found.append(Finding("process_noise", "record", "named", "record", (), values, None, None, message))
    if residual_test(np.where(np.isnan(used.y), np.nan, e[: used.samples]), used.u).feedback:
        message = (
            "The residual is correlated with future inputs: the record may come from a closed loop. Crosstalk from an "
            "input looks the same and is not told from it."
        )
        found.append(Finding("closed_loop", "record", "named", "record", (), {}, None, None, message))
    return tuple(found)
