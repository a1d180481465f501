"""Which starts are refined: the subspace start alone where it serves, otherwise several of three kinds."""

import warnings

from ...mechanics.systems.drives import Force
from ...numerics.outcomes import ComputationError
from ...numerics.progress import AbstractProgress
from ..setup.prediction import Setting
from ..setup.preparation import Signals
from .modal_start import modal_start
from .start import Start, StartOptions, regression_start, subspace_starts


def starts_of(
    signals: list[Signals], setting: Setting, sampling_time: float, options: StartOptions, progress: AbstractProgress
) -> list[Start]:
    """Starting models, best first: one where it serves, otherwise all that subspace, regression and modes give.

    **Arguments:** `signals`: scaled records; `setting`; `sampling_time` [s]; `options`; `progress`.

    **Raises:** `ComputationError` when there is none.
    """
    progress.stage("subspace start")
    found: list[Start] = []
    failure = None
    try:
        found = subspace_starts(signals, setting, sampling_time, options)
    except ComputationError as error:
        failure = error
    if found and found[0].serves:
        return found[:1]
    others = other_starts(signals, setting, sampling_time, options, found[0] if found else None, progress)
    if not found and not others:
        raise failure
    return sorted(found + others, key=lambda start: -start.score)


def other_starts(
    signals: list[Signals],
    setting: Setting,
    sampling_time: float,
    options: StartOptions,
    first: Start | None,
    progress: AbstractProgress,
) -> list[Start]:
    """Those that regression and modes give, none where they fail.

    **Arguments:** as of `starts_of`; `first`: a model whose free run may serve as instruments.
    """
    if not isinstance(setting.drive, Force):
        return []
    found = []
    for name, start in (
        ("regression", lambda: regression_start(signals, setting, options.time_constants, sampling_time, first)),
        ("modal", lambda: modal_start(signals, setting)),
    ):
        progress.stage(f"{name} start")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                found.append(start())
        except ComputationError:
            continue
    return found
