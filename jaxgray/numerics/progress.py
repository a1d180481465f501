"""Progress that is passed down and silent by default; showing it is the upper floors' business."""

import abc


class AbstractProgress(abc.ABC):
    """Told what is being done, never what to print; from several threads where laws are refitted beside one another."""

    @abc.abstractmethod
    def stage(self, name: str, *, fraction: float | None = None) -> None:
        """A new stage begins; `fraction` of the whole that lies behind, where it is known."""


class Silent(AbstractProgress):
    """Shows nothing."""

    def stage(self, name: str, *, fraction: float | None = None) -> None:
        pass
