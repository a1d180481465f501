"""Progress that is passed down and silent by default; showing it is the upper floors' business."""

import abc
import time


class AbstractProgress(abc.ABC):
    """Told what is being done, never what to print; from several threads where laws are refitted beside one another."""

    @abc.abstractmethod
    def stage(self, name: str, *, fraction: float | None = None) -> None:
        """A new stage begins; `fraction` of the whole that lies behind, where it is known."""

    @property
    def unlimited(self) -> "AbstractProgress":
        """The same for what must be done whatever time it takes."""
        return self


class BudgetSpent(Exception):
    """Raised where a new stage would begin after the time for all of them is over."""


class Budgeted(AbstractProgress):
    """Told of stages until some seconds have passed since it was made, then refuses them.

    **Arguments:** `told`: what is told of the stages; `seconds`, None for no limit.

    **Raises:** `BudgetSpent` by `stage`; `ended` is then the name of the first stage that was refused.
    """

    def __init__(self, told: AbstractProgress, seconds: float | None):
        self._told, self._seconds, self._begun = told, seconds, time.monotonic()
        self.ended: str | None = None

    @property
    def unlimited(self):
        return self._told.unlimited

    def stage(self, name, *, fraction=None):
        if self._seconds is not None and time.monotonic() - self._begun >= self._seconds:
            self.ended = self.ended or name
            raise BudgetSpent(name)
        self._told.stage(name, fraction=fraction)


class Silent(AbstractProgress):
    """Shows nothing."""

    def stage(self, name: str, *, fraction: float | None = None) -> None:
        pass
