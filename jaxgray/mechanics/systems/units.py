"""Units as text, composed from those of the channels."""

from .drives import ORDER

_ENDINGS = {"velocity": ("/s",), "acceleration": ("/s^2", "/s²", "/s2")}


def displacement_unit(unit: str, measured: str) -> str:
    """Unit of the displacement that goes with a measured quantity: m/s^2 of an acceleration gives m.

    **Arguments:** `unit` of the channel; `measured`: "displacement", "velocity" or "acceleration".

    **Returns:** the unit, empty where none is given.
    """
    unit = unit.strip()
    for ending in _ENDINGS.get(measured, ()):
        if unit.endswith(ending):
            return unit[: -len(ending)]
    if measured == "displacement" or not unit:
        return unit
    return f"{as_factor(unit)} {'s' if ORDER[measured] == 1 else 's^2'}"


def as_factor(unit: str) -> str:
    """In brackets where it would not bind as one factor."""
    return f"({unit})" if any(c in unit for c in " /*") else unit


def composed_unit(powers: tuple[int, int, int], force: str, length: str, *, per_mass: bool = False) -> str:
    """Unit of a parameter as text, such as N/m^3; empty where a unit that it needs is not given.

    **Arguments:** `powers` of force, length and time; `force`, `length`: their units; `per_mass`: forces are those on a
    mass of one, as under a moving base, which leaves the scale of masses open.
    """
    if per_mass:
        powers = 0, powers[1] + powers[0], powers[2] - 2 * powers[0]
    names = (force, length, "s")
    if any(power and not name for power, name in zip(powers, names)):
        return ""
    over = [_power(n, p) for n, p in zip(names, powers) if p > 0]
    under = [_power(n, -p) for n, p in zip(names, powers) if p < 0]
    if not under:
        return " ".join(over)
    bottom = under[0] if len(under) == 1 else f"({' '.join(under)})"
    return f"{' '.join(over) or '1'}/{bottom}"


def _power(name: str, power: int) -> str:
    return name if power == 1 else f"{as_factor(name)}^{power}"
