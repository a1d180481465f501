"""Physical structure with hidden coordinates: springs and dampers between named coordinates, masses of their own.

"y1-h1, h1-h2, h2-ground" has a spring and a damper in parallel at every connection, none elsewhere, and one mass a
coordinate. "y1-ground:damper" (or ":spring") is one of the two alone.
"""

import re

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ....numerics.matrices.namespace import namespace
from ...setup.structure import NAMES, AbstractAssembly, Diagonal, Structure

GROUND = "ground"
KINDS = {"spring": ("stiffness",), "damper": ("damping",), "": ("damping", "stiffness")}


class Connected(AbstractAssembly):
    """Elements ≥ 0, each between two coordinates or from one to ground.

    `arms`: a row an element, ±1 at its ends; `coordinates`: units in which the coordinates are counted, None where all
    are the same.
    """

    arms: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    coordinates: Float[Array, " dofs"] | None = None

    @property
    def positive(self):
        # Singular where the structure has no spring to ground, which is no edge.
        return False

    @property
    def sized(self):
        return False

    def sizes(self, dofs):
        return (1,) * len(self.arms)

    def scaled(self, coordinates):
        return Connected(self.arms, coordinates if self.coordinates is None else self.coordinates * coordinates)

    def _pulls(self, dofs):
        """What a unit of every element does to the scaled coordinates, the largest pull one."""
        xp = namespace(self.coordinates)
        units = xp.ones(dofs) if self.coordinates is None else self.coordinates
        pulls = np.array(self.arms).reshape(-1, dofs) * units
        return pulls / xp.max(xp.abs(pulls), axis=1, keepdims=True)

    @property
    def units(self) -> Float[np.ndarray, " elements"]:
        """How many of the scaled units one unit of every element is."""
        arms = np.array(self.arms)
        units = 1.0 if self.coordinates is None else np.asarray(self.coordinates)
        return np.max(np.abs(arms * units), axis=1) ** 2 if len(arms) else np.zeros(0)

    def matrix(self, blocks, mass, stiffness):
        if not blocks:
            return namespace(mass).zeros_like(mass)
        xp = namespace(*blocks, self.coordinates)
        pulls = self._pulls(len(self.arms[0]))
        return xp.einsum("s,si,sj->ij", xp.stack([block[0, 0] for block in blocks]), pulls, pulls)

    def blocks(self, matrix, mass, stiffness):
        if not self.arms:
            return []
        xp = namespace(matrix, self.coordinates)
        pulls = self._pulls(matrix.shape[0])
        rows, columns = np.triu_indices(matrix.shape[0])
        table = (pulls[:, rows] * pulls[:, columns]).T
        found = xp.linalg.lstsq(table, (matrix + matrix.T)[rows, columns] / 2, rcond=None)[0]
        return [xp.reshape(found[k], (1, 1)) for k in range(len(self.arms))]


class Connections:
    """What a text such as "y1-h1, h1-ground:damper" says.

    `names`: of the coordinates; `dampers`, `springs`: the connections, in words, in the order of the arms.
    """

    def __init__(self, text: str, names: tuple[str, ...]):
        self.names = names
        found: dict[str, dict[str, np.ndarray]] = {"damping": {}, "stiffness": {}}
        for item in filter(None, (part.strip() for part in text.split(","))):
            place, _, kind = item.partition(":")
            kind = kind.strip().lower()
            if kind not in KINDS:
                raise ValueError(f"structure={text!r}: {item!r} ends in neither :spring nor :damper; leave it out.")
            name, arm = _arm(place.strip(), names, text)
            for owner in KINDS[kind]:
                if name in found[owner]:
                    raise ValueError(f"structure={text!r} names {name} twice; name every connection once.")
                found[owner][name] = arm
        self.dampers, self.springs = tuple(found["damping"]), tuple(found["stiffness"])
        self._arms = {owner: list(arms.values()) for owner, arms in found.items()}
        touched = np.zeros(len(names), bool)
        for arm in self._arms["damping"] + self._arms["stiffness"]:
            touched |= arm != 0
        if not touched.all() and len(names) > 1:
            alone = ", ".join(name for name, known in zip(names, touched) if not known)
            raise ValueError(f"structure={text!r} connects nothing to {alone}; name a connection for it.")

    def _connected(self, owner: str) -> Connected:
        return Connected(tuple(tuple(arm.tolist()) for arm in self._arms[owner]))

    @property
    def structure(self) -> Structure:
        """Diagonal mass, dampers and springs at the connections."""
        return Structure(Diagonal(), self._connected("damping"), self._connected("stiffness"))

    def element(self, owner: str, name: str) -> int | None:
        """Position of the mass, damper or spring of this name among its kind; None where there is none."""
        if owner == "mass":
            return self.names.index(name) if name in self.names else None
        wanted = _parts(name)
        for k, known in enumerate(self.dampers if owner == "damping" else self.springs):
            if sorted(_parts(known)) == sorted(wanted):
                return k
        return None

    @property
    def elements(self) -> tuple[str, ...]:
        """All elements in the order of the structure's blocks: mass[y1], …, damping[y1-h1], …, stiffness[y1-h1], …"""
        return (
            *(f"mass[{name}]" for name in self.names),
            *(f"damping[{name}]" for name in self.dampers),
            *(f"stiffness[{name}]" for name in self.springs),
        )


def _parts(place: str) -> list[str]:
    return [part.strip() for part in place.split("-")]


def _arm(place: str, names: tuple[str, ...], text: str) -> tuple[str, np.ndarray]:
    """Name and arm of one connection; names may themselves hold a hyphen."""
    ends = (*names, GROUND)
    written = place.replace(" - ", "-")
    pairs = [(first, second) for first in ends for second in ends if written == f"{first}-{second}"]
    if len(pairs) != 1 or pairs[0][0] == pairs[0][1]:
        raise ValueError(
            f"structure={text!r}: {place!r} is no connection of two of {', '.join(ends)}; write for example "
            f"'{names[0]}-{names[-1] if len(names) > 1 else GROUND}'."
        )
    first, second = pairs[0]
    arm = np.zeros(len(names))
    for name, sign in ((first, 1.0), (second, -1.0)):
        if name != GROUND:
            arm[names.index(name)] = sign
    return f"{first}-{second}", arm


def is_connections(structure, names: tuple[str, ...]) -> bool:
    """Whether a structure is given by connections of some coordinates rather than by the names of assemblies."""
    text = structure if isinstance(structure, str) else ",".join(structure or ())
    places = [part.partition(":")[0].strip() for part in text.split(",") if part.strip()]
    ends = (*names, GROUND)
    return any(
        place not in NAMES and any(place.startswith(f"{end}-") or place.endswith(f"-{end}") for end in ends)
        for place in places
    )


_ELEMENT = re.compile(r"^\s*(mass|damping|stiffness)\s*\[\s*([^\]]+?)\s*\]\s*$")


def fixed_elements(fix, connections: Connections) -> dict[tuple[str, int], float]:
    """Known masses, dampers and springs from "mass[y1]=2, stiffness[y1-h1]=100" or a mapping.

    **Raises:** `ValueError` for what the structure has not.
    """
    if not fix:
        return {}
    if isinstance(fix, str):
        items = [part.rpartition("=")[::2] for part in re.split(r",(?![^\[]*\])", fix) if part.strip()]
    else:
        items = list(fix.items())
    known = {}
    for key, value in items:
        match = _ELEMENT.match(str(key))
        position = None if match is None else connections.element(match[1], match[2])
        if position is None and match is not None:
            position = _by_entry(match[1], match[2], connections)
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = np.nan
        if position is None or not (np.isfinite(number) and number >= 0):
            raise ValueError(
                f"fix: {key}={value} is no element of this structure; those are {', '.join(connections.elements)}."
            )
        known[match[1], position] = number
    return known


def _by_entry(owner: str, text: str, connections: Connections) -> int | None:
    """mass[k,k] by position."""
    numbers = re.fullmatch(r"(\d+)\s*,\s*(\d+)", text)
    if owner != "mass" or numbers is None or numbers[1] != numbers[2]:
        return None
    return int(numbers[1]) if int(numbers[1]) < len(connections.names) else None
