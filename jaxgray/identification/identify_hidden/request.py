"""What is asked for where coordinates are hidden."""

from dataclasses import dataclass, replace

from ...mechanics.model import hidden_names
from ...records import Record
from ..hidden import is_connections


@dataclass(frozen=True)
class HiddenRequest:
    """What is asked for: `structure`: connections, None for the canonical form; `fix`; `noise`; how the input enters;
    what the start is looked for with; whether to `refine`; `names` of the hidden coordinates."""

    structure: object
    fix: object
    noise: str
    excitation: str
    input_map: object
    relative: bool
    time_constants: object
    block_rows: object
    weight: object
    map: object
    refine: bool
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, options: dict) -> "HiddenRequest":
        """What some options of `identify` ask for, those that are not among them at their defaults."""
        usual = {"structure": None, "fix": None, "noise": "output-error", "excitation": "force", "input_map": None}
        usual |= {"relative": False, "time_constants": None, "block_rows": None, "weight": "moesp", "map": "exact"}
        usual |= {"refine": True}
        return cls(**{name: options.get(name, value) for name, value in usual.items()})

    def named(self, hidden, outputs: tuple[str, ...]) -> "HiddenRequest":
        """The request with its hidden coordinates, its structure as text.

        **Arguments:** `hidden`: how many, or their names; `outputs`: names of the outputs.

        **Raises:** `ValueError` where these, or the structure, are not understood.
        """
        given = self.structure
        text = given if given is None or isinstance(given, str) else ", ".join(given)
        names = hidden_names(hidden)
        if len({*outputs, *names}) < len(outputs + names):
            raise ValueError(f"hidden={hidden!r} repeats a name; coordinates are {', '.join(outputs + names)}.")
        if text and not is_connections(text, outputs + names):
            raise ValueError(
                f"structure={given!r} says nothing of hidden coordinates; say how they are connected, such as "
                f"'{outputs[0]}-{names[0] if names else 'ground'}' (masses are diagonal then)."
            )
        return replace(self, names=names, structure=text or None)


def wants_hidden(hidden, structure, outputs: tuple[str, ...]) -> bool:
    """Whether a model with hidden coordinates, or with named connections, is asked for; `outputs`: their names.

    **Raises:** `ValueError` where `hidden` is not understood.
    """
    if hidden == "auto":
        return True
    if isinstance(hidden, str):
        raise ValueError(f"hidden={hidden!r} is not understood; give a number, 'auto', or a list of names.")
    return bool(hidden_names(hidden)) or is_connections(structure, outputs)


def example(record: Record, names: tuple[str, ...]) -> str:
    every = (*record.output_names, *names)
    return ", ".join(f"{a}-{b}" for a, b in zip(every, every[1:])) or f"{every[0]}-ground"
