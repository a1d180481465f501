"""Readable names: of effects and places, and of what was estimated."""

import re

from ...numerics.text import plus_minus
from ..findings import Estimate

SHOWN = 3
"""Parameters of one effect, and outputs, that a sentence names at most."""

NAMES = {
    "cubic_stiffness": "cubic stiffness",
    "quadratic_stiffness": "quadratic stiffness",
    "dead_zone_stiffness": "stiffness with a dead zone",
    "end_stop": "end stop",
    "bilinear_stiffness": "bilinear stiffness",
    "sine_stiffness": "sine-shaped stiffness",
    "constant_force": "constant force",
    "position_dependent_stiffness": "scheduled stiffness",
    "coulomb_friction": "Coulomb friction",
    "stribeck_friction": "Stribeck friction",
    "asymmetric_friction": "asymmetric friction",
    "quadratic_drag": "quadratic drag",
    "position_dependent_friction": "position-dependent friction",
    "load_friction": "load-dependent friction",
    "fractional_damping": "fractional (structural) damping",
    "dahl_friction": "Dahl friction",
    "bouc_wen_hysteresis": "Bouc-Wen hysteresis",
    "maxwell_slip_hysteresis": "Maxwell-slip hysteresis",
    "gyroscopic_coupling": "gyroscopic coupling",
    "circulatory_coupling": "circulatory coupling",
    "input_delay": "input delay",
    "actuator_lag": "actuator lag",
    "intersample_hold": "another hold between samples",
    "band_limited_input": "band-limited input between samples",
    "input_saturation": "input saturation",
    "speed_force_limit": "force limit that falls with speed",
    "input_dead_zone": "input dead zone",
    "input_quadratic": "quadratic input",
    "input_position_gain": "motion-dependent input gain",
    "play_hysteresis": "play hysteresis",
    "actuator_creep": "actuator creep",
    "sensor_offset": "sensor offset",
    "sensor_drift": "sensor drift",
    "sensor_delay": "sensor delay",
    "sensor_lag": "sensor lag",
    "sensor_crosstalk": "sensor crosstalk",
    "sensor_nonlinearity": "sensor nonlinearity",
    "clock_scale": "clock running at another rate",
    "unmodelled_mode": "unmodelled mode",
    "stiffness_drift": "stiffness drift",
    "stiffness_step": "stiffness step",
    "mass_step": "mass step",
    "periodic_disturbance": "periodic disturbance",
    "force_step": "force step",
    "mass_error": "wrong mass",
    "damping_error": "wrong damping",
    "stiffness_error": "wrong stiffness",
    "parameter_error": "wrong number",
    "sensor_clipping": "sensor clipping",
    "sensor_quantization": "sensor quantization",
    "outliers": "outliers",
    "dropped_samples": "dropped samples",
    "process_noise": "process noise",
    "closed_loop": "closed loop",
}
"""What an effect is called in a sentence."""


_NUMBER = re.compile(r"^(\S+) of (\w+) at (.+)$")
"""A number of a law as the place of a finding."""


def name_of(effect: str) -> str:
    """What an effect is called in a sentence, from its id."""
    return NAMES.get(effect, effect.replace("_", " "))


def place_of(location: str, names: tuple[str, ...] = ()) -> str:
    """A place in words: "at y1", "between y1 and y2", "from u1 to y1".

    **Arguments:** `location`: as in files; `names`: of the outputs, which may have hyphens of their own; default
    none, then one hyphen parts two names.

    **Returns:** the words, empty for no place.
    """
    if not location:
        return ""
    if location == "record":
        return "in the record"
    if (number := _NUMBER.match(location)) is not None:
        return f"at {number[1]} of {title_of(number[2], number[3], names)}"
    if "->" in location:
        source, _, target = location.partition("->")
        return f"from {source} to {target}"
    if location not in names:
        cuts = [k for k, letter in enumerate(location) if letter == "-"]
        pairs = [(location[:k], location[k + 1 :]) for k in cuts]
        for first, second in pairs:
            if (first in names and second in names) or (not names and len(pairs) == 1):
                return f"between {first} and {second}"
    return f"at {location}"


def title_of(effect: str, location: str, names: tuple[str, ...] = ()) -> str:
    """Name and place: "Coulomb friction at y1"."""
    if (number := number_of(effect, location, names)) is not None:
        return f"wrong {number}"
    return f"{name_of(effect)} {place_of(location, names)}".strip()


def number_of(effect: str, location: str, names: tuple[str, ...] = ()) -> str | None:
    """A wrong number of a law in words, "Fc of Coulomb friction at y1"; None for other effects."""
    if effect != "parameter_error" or not location:
        return None
    return place_of(location, names).removeprefix("at ")


def value_text(value, error, unit: str = "", *, digits: int = 2) -> str:
    """A number, or several, ± standard error with the unit; a word as it is."""
    if isinstance(value, str):
        return value
    if isinstance(value, list | tuple):
        errors = error if isinstance(error, list | tuple) else [None] * len(value)
        text = ", ".join(plus_minus(v, e, digits=digits) for v, e in zip(value, errors))
    else:
        text = plus_minus(value, error, digits=digits)
    return f"{text} {unit}".strip()


def parameters_text(parameters: dict[str, Estimate], *, digits: int = 1, most: int = SHOWN) -> str:
    """What was estimated, "Fc = 0.241 ± 0.002 N"; what was fixed is left out unless it is a word or all there is."""
    told = {k: e for k, e in parameters.items() if e.standard_error is not None or isinstance(e.value, str)}
    parts = [
        f"{name} = {value_text(e.value, e.standard_error, e.unit, digits=digits)}"
        for name, e in list((told or parameters).items())[:most]
    ]
    return ", ".join(parts)
