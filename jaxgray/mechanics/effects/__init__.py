"""The catalogue of physical effects: one family per file, one class per effect.

base             what every effect is
friction         forces against the velocity
stiffness        restoring forces
hysteresis       forces with memory
actuator         inputs before they act
between_samples  inputs between their samples
sensor           outputs between the motion and the record
structure        one more mode, or parameters that change over time
disturbance      forces that nobody recorded
coupling         entries of M, D, K that are not symmetric, or wrong
"""

import difflib

from . import actuator, between_samples, coupling, disturbance, friction, hysteresis, sensor, stiffness, structure
from .base import (
    AbstractEffect,
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Local,
    Parameter,
    Place,
    Scales,
    Term,
    places_of,
)

__all__ = [
    "CATALOGUE",
    "MODEL_ERRORS",
    "RECORD_FINDINGS",
    "AbstractEffect",
    "AbstractForceEffect",
    "AbstractInputEffect",
    "AbstractMatrixEffect",
    "AbstractOutputEffect",
    "Local",
    "Parameter",
    "Place",
    "Scales",
    "Term",
    "by_id",
    "places_of",
]

CATALOGUE: tuple[AbstractEffect, ...] = (
    stiffness.CubicStiffness(),
    stiffness.QuadraticStiffness(),
    stiffness.DeadZoneStiffness(),
    stiffness.EndStop(),
    stiffness.BilinearStiffness(),
    stiffness.SineStiffness(),
    stiffness.ConstantForce(),
    stiffness.PositionDependentStiffness(),
    friction.CoulombFriction(),
    friction.StribeckFriction(),
    friction.AsymmetricFriction(),
    friction.QuadraticDrag(),
    friction.PositionDependentFriction(),
    friction.LoadFriction(),
    friction.FractionalDamping(),
    hysteresis.DahlFriction(),
    hysteresis.BoucWenHysteresis(),
    hysteresis.MaxwellSlipHysteresis(),
    coupling.GyroscopicCoupling(),
    coupling.CirculatoryCoupling(),
    actuator.InputDelay(),
    actuator.ActuatorLag(),
    between_samples.IntersampleHold(),
    between_samples.BandLimitedInput(),
    actuator.InputSaturation(),
    actuator.SpeedForceLimit(),
    actuator.InputDeadZone(),
    actuator.InputQuadratic(),
    actuator.InputPositionGain(),
    actuator.PlayHysteresis(),
    actuator.ActuatorCreep(),
    sensor.SensorOffset(),
    sensor.SensorDrift(),
    sensor.SensorDelay(),
    sensor.SensorLag(),
    sensor.SensorCrosstalk(),
    sensor.SensorNonlinearity(),
    sensor.ClockScale(),
    sensor.DroppedSamples(),
    structure.UnmodelledMode(),
    structure.StiffnessDrift(),
    structure.StiffnessStep(),
    structure.MassStep(),
    disturbance.PeriodicDisturbance(),
    disturbance.ForceStep(),
)
"""Every effect that a linear model identified from the record may lack."""

MODEL_ERRORS: tuple[AbstractEffect, ...] = (
    coupling.MassError(),
    coupling.DampingError(),
    coupling.StiffnessError(),
)
"""Wrong numbers in the user's own model: tested before any law, and only there."""

RECORD_FINDINGS: dict[str, str] = {
    "sensor_clipping": "the sensor ends at a limit: many samples at the same extreme value",
    "sensor_quantization": "the resolution of the sensor is coarse against its noise",
    "outliers": "single samples far off their neighbours",
    "process_noise": "unrecorded random forces move the plant: not repeatable over periods",
    "closed_loop": "the input depends on the output: the residual is correlated with the future input",
}
"""Findings on the record itself, that are not simulated."""


def by_id(id: str) -> AbstractEffect:
    """The effect of this id, of the catalogue or of the errors of a given model.

    **Arguments:** `id`: as in files and messages, such as "cubic_stiffness".

    **Returns:** the effect.

    **Raises:** `ValueError` where there is none of this id.
    """
    known = {effect.id: effect for effect in CATALOGUE + MODEL_ERRORS}
    if id in known:
        return known[id]
    if id in RECORD_FINDINGS:
        raise ValueError(f"{id} is a finding on the record ({RECORD_FINDINGS[id]}), not an effect that is simulated.")
    near = difflib.get_close_matches(str(id)[:80], known, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(known)}."
    raise ValueError(f"there is no effect {str(id)[:80]!r}; {hint}")
