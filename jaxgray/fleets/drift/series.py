"""Which machine a record is of, when it was made, and under which conditions: from file names and columns."""

import datetime
import re
from dataclasses import dataclass
from pathlib import Path

FIELDS = ("machine", "when")


@dataclass(frozen=True)
class Naming:
    """How a fleet's records belong together.

    `pattern`: of the file names, compiled, None where they say nothing; `when_column`: a column that says when, or
    None; `covariates`: columns of the conditions.
    """

    pattern: re.Pattern | None
    when_column: str | None
    covariates: tuple[str, ...]

    @classmethod
    def of(cls, machine: str | None, when_column: str | None, covariates: tuple[str, ...]) -> "Naming":
        """From a pattern such as `"{machine}_{when}.parquet"`, in which `*` stands for anything.

        **Raises:** `ValueError` for a pattern without `{machine}`.
        """
        if machine is None:
            return cls(None, when_column, covariates)
        wanted = re.findall(r"\{(\w*)\}", machine)
        if "machine" not in wanted or not set(wanted) <= set(FIELDS) or len(set(wanted)) < len(wanted):
            raise ValueError(
                f"machine is {machine!r}; give a pattern of the file names with {{machine}} and, where they say it, "
                "{when}, such as '{machine}_{when}.parquet'."
            )
        text = "".join(
            f"(?P<{part[1:-1]}>.+)" if part.startswith("{") else ".*" if part == "*" else re.escape(part)
            for part in re.split(r"(\{\w+\}|\*)", machine)
            if part
        )
        return cls(re.compile(text), when_column, covariates)

    def check(self, files: list[Path]) -> None:
        """Raise `ValueError` for the first file name that the pattern does not fit."""
        if self.pattern is None:
            return
        for file in files:
            if self.pattern.fullmatch(file.name) is None and self.pattern.fullmatch(file.as_posix()) is None:
                raise ValueError(
                    f"machine: the pattern does not fit {file.name}; give one that fits all names, or fewer files."
                )

    def machine_and_when(self, file: str, columns: dict[str, float]) -> tuple[str | None, str | None, float | None]:
        """The machine, when as text, and when as a number that orders records (days since 1970 for dates)."""
        machine = text = None
        if self.pattern is not None:
            found = self.pattern.fullmatch(Path(file).name) or self.pattern.fullmatch(Path(file).as_posix())
            parts = found.groupdict()
            machine, text = parts["machine"], parts.get("when")
        if self.when_column is not None and self.when_column in columns:
            return machine, f"{columns[self.when_column]:.9g}", float(columns[self.when_column])
        return machine, text, None if text is None else _number(text)


def _number(text: str) -> float | None:
    """A number, or an ISO date as days since 1970; None for neither."""
    # To Python an underscore may stand inside a number.
    if "_" not in text:
        try:
            return float(text)
        except ValueError:
            pass
    for form in (text, text.replace("_", "T"), text.replace("-", "")):
        try:
            moment = datetime.datetime.fromisoformat(form)
        except ValueError:
            continue
        zone = moment.tzinfo or datetime.UTC
        return moment.replace(tzinfo=zone).timestamp() / 86400.0
    return None
