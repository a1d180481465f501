"""What is said of a record as it was measured."""

from collections.abc import Mapping
from dataclasses import dataclass, field

SEVERITIES = ("note", "warning", "error")


@dataclass(frozen=True)
class RecordFinding:
    """One thing that is wrong with a record as it was measured.

    **Arguments:**

    - `effect`: id of the finding, such as `sensor_clipping`.
    - `location`: the channel's name, or `record`.
    - `message`: one sentence on what was seen, one on what to do.
    - `severity`: `"note"`, `"warning"`, or `"error"` where nothing can be identified from that channel.
    - `values`: the figures behind the message.
    """

    effect: str
    location: str
    message: str
    severity: str = "warning"
    values: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self):
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity is {self.severity!r}; give one of {', '.join(SEVERITIES)}.")
