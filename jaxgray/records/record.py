"""The record: what was measured, when, in which units, and what is missing."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxgray.numerics.responses.band_limited import band_limited
from jaxgray.records.channels import (
    as_channels,
    as_seconds,
    as_texts,
    channel_positions,
    measured_per_output,
    without_trend,
)
from jaxgray.records.describe import describe
from jaxgray.records.periods import between_periods, find_period
from jaxgray.records.stamped import Stamps, grid_of

HOLDS = ("zero", "linear", "band-limited")


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Record:
    """One record of inputs and outputs at a uniform sampling time, immutable.

    Where rows have times of their own (`Record.from_stamps`), the record keeps them as `stamps`, and `u` and `y` hold
    the channels on a uniform grid as well; `identify` and `diagnose` use the stamps.

    **Arguments:**

    - `u`: inputs `(samples, inputs)`, finite; one dimension is one input.
    - `y`: outputs `(samples, outputs)`, NaN where a sample is missing; one dimension is one output.
    - `sampling_time`: time between samples in s.
    - `input_names`, `output_names`: names of the channels; default `u1`, `u2`, … and `y1`, `y2`, ….
    - `input_units`, `output_units`: units of the channels as text; default empty. Values stay in them.
    - `hold`: the input between samples, `"zero"` (constant, default), `"linear"`, or `"band-limited"`: measured behind
      an anti-alias filter. A band-limited input is stored as other samples, chosen so that straight lines between them
      move a plant as the input does; `hold` is then "linear".
    - `measured`: what the outputs are, `"displacement"` (default), `"velocity"` or `"acceleration"`, one for
        all or one per output.
    - `scheduling`: one more channel `(samples,)` on which the system may depend; default none.
    - `scheduling_name`: its name; default `p` where there is such a channel.
    - `start_time`: time of the first sample in s; default 0.
    - `stamps`: rows at times of their own; default none. `Record.from_stamps` makes them.

    **Raises:** `ValueError` where an argument does not fit, saying which and what to do.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> record = jaxgray.Record(np.ones(100), np.zeros((100, 2)), 0.01, output_names=("base", "tip"))
        >>> record.samples, record.inputs, record.output_names
        (100, 1, ('base', 'tip'))
    """

    u: Float[np.ndarray, "samples inputs"]
    y: Float[np.ndarray, "samples outputs"]
    sampling_time: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    hold: str
    measured: tuple[str, ...]
    scheduling: Float[np.ndarray, " samples"] | None
    scheduling_name: str | None
    start_time: float
    stamps: Stamps | None

    # Written out, because it takes more than it stores: lists, single channels, one word for all outputs.
    def __init__(
        self,
        u,
        y,
        sampling_time,
        *,
        input_names=None,
        output_names=None,
        input_units=None,
        output_units=None,
        hold="zero",
        measured="displacement",
        scheduling=None,
        scheduling_name=None,
        start_time=0.0,
        stamps=None,
    ):
        def store(name, value):
            object.__setattr__(self, name, value)

        store("u", as_channels("u", u))
        store("y", as_channels("y", y))
        if self.u.shape[0] != self.y.shape[0]:
            raise ValueError(
                f"u has {self.u.shape[0]} samples and y has {self.y.shape[0]}; give both the same number "
                "(time is the first axis)."
            )
        if self.samples < 2:
            raise ValueError(f"u and y have {self.samples} samples; a record needs at least 2.")
        if np.isnan(self.u).any():
            row, column = np.argwhere(np.isnan(self.u))[0]
            raise ValueError(
                f"u is NaN at sample {row} of input {column}; only outputs may be missing: fill or cut the input."
            )
        store("sampling_time", as_seconds("sampling_time", sampling_time))
        store("start_time", as_seconds("start_time", start_time, positive=False))

        store("input_names", as_texts("input_names", input_names, self.inputs, "u{}"))
        store("output_names", as_texts("output_names", output_names, self.outputs, "y{}"))
        names = self.input_names + self.output_names
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice or "" in names:
            raise ValueError(f"input_names and output_names are {names}; give every channel a name of its own.")
        store("input_units", as_texts("input_units", input_units, self.inputs, ""))
        store("output_units", as_texts("output_units", output_units, self.outputs, ""))

        if hold not in HOLDS:
            raise ValueError(f"hold is {hold!r}; give one of {', '.join(HOLDS)}.")
        store("hold", hold)
        store("measured", measured_per_output(measured, self.outputs))
        if hold == "band-limited":
            if "acceleration" in self.measured:
                raise ValueError(
                    "hold is 'band-limited' and measured holds accelerations, which show the input at its samples as "
                    "well; give hold='linear'."
                )
            store("u", np.stack([band_limited(column) for column in self.u.T], axis=1))
            store("hold", "linear")

        if scheduling is not None:
            p = as_channels("scheduling", scheduling)
            if p.shape != (self.samples, 1) or np.isnan(p).any():
                raise ValueError(
                    f"scheduling has shape {np.shape(scheduling)} or holds NaN; give one finite value "
                    f"for each of the {self.samples} samples."
                )
            store("scheduling", p[:, 0])
            store("scheduling_name", "p" if scheduling_name is None else str(scheduling_name))
        elif scheduling_name is None:
            store("scheduling", None)
            store("scheduling_name", None)
        else:
            raise ValueError(f"scheduling_name is {scheduling_name!r} but scheduling is missing; give the channel too.")
        store("stamps", stamps)

    @classmethod
    def from_stamps(cls, time, u, y, *, hold="zero", sampling_time=None, clock=None, **more) -> "Record":
        """A record of rows at times of their own: jittered, irregular, or with channels at several rates.

        Channels of other rates share one table: a row for every time at which anything was sampled, inputs with the
        value that they have then, outputs NaN where they have no sample.

        **Arguments:**

        - `time`: of every row in s, increasing.
        - `u`: inputs `(rows, inputs)`, finite.
        - `y`: outputs `(rows, outputs)`, NaN where a row has no sample.
        - `hold`: the input from a row to the next, `"zero"` (constant, default) or `"linear"`.
        - `sampling_time`: step of the grid in s; default by the rows, about their mean step.
        - `clock`: number of the clock that gave each row its time, 0 for that of the inputs; default all 0. Any other
          clock may have another rate and an offset: `identify` estimates both.
        - `more`: names, units and measured quantities, as for `Record`.

        **Returns:** a `Record` on a uniform grid, its rows in `stamps`.

        **Raises:** `ValueError` where an argument does not fit.
        """
        u, y = as_channels("u", u), as_channels("y", y)
        time = as_channels("time", time)[:, 0]
        if not len(time) == len(u) == len(y):
            raise ValueError(f"time has {len(time)} rows, u {len(u)} and y {len(y)}; give all the same number.")
        for name, values in (("time", time), ("u", u)):
            if not np.isfinite(values).all():
                row = np.argwhere(~np.isfinite(values))[0][0]
                raise ValueError(f"{name} is not finite at row {row}; only outputs may be missing.")
        clock = np.zeros(len(time), int) if clock is None else np.asarray(clock)
        if clock.shape != time.shape or clock.dtype.kind not in "iu" or not np.any(clock == 0):
            raise ValueError("clock must be a whole number for every row, 0 for those of the inputs' clock.")
        back = np.flatnonzero((np.diff(time) < 0) | ((np.diff(time) == 0) & (np.diff(clock) == 0)))
        if back.size:
            k = back[0]
            raise ValueError(
                f"time does not increase at row {k + 1} ({time[k]:.9g} s, then {time[k + 1]:.9g} s); sort the rows and "
                "put those of one time together."
            )
        if hold not in ("zero", "linear"):
            raise ValueError(f"hold is {hold!r}; for rows with times of their own give 'zero' or 'linear'.")
        if "scheduling" in more:
            raise ValueError("scheduling is a channel of uniform records; leave it out.")
        step = None if sampling_time is None else as_seconds("sampling_time", sampling_time)
        own = clock == 0
        grid = grid_of(time, time[own], u[own], y, hold, step, clock)
        return cls(grid.u, grid.y, grid.step, hold=grid.hold, start_time=grid.start, stamps=grid.stamps, **more)

    @property
    def has_own_times(self) -> bool:
        """Whether its rows, at times of their own, are used instead of the channels on the grid."""
        return self.stamps is not None and self.stamps.counted

    @property
    def on_grid(self) -> "Record":
        """The record as its channels on the grid are, without regard to the times of its rows."""
        return replace(self, stamps=replace(self.stamps, counted=False)) if self.has_own_times else self

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.u.shape[0]

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.u.shape[1]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.y.shape[1]

    @property
    def duration(self) -> float:
        """Length in s, samples times sampling time."""
        return self.samples * self.sampling_time

    @property
    def sampling_rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return 1.0 / self.sampling_time

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Time of every sample in s."""
        return self.start_time + self.sampling_time * np.arange(self.samples)

    @property
    def missing(self) -> Bool[np.ndarray, "samples outputs"]:
        """True where an output sample is missing."""
        return np.isnan(self.y)

    @property
    def lost(self) -> Bool[np.ndarray, "samples outputs"]:
        """True where an output sample that was due is missing; gaps between the rows of an output at times of its own
        do not count."""
        return self.missing if self.stamps is None else self.missing & self.stamps.sampled(self.samples)

    @property
    def has_missing(self) -> bool:
        """Whether any output sample is missing."""
        return bool(self.missing.any())

    def __len__(self) -> int:
        return self.samples

    # Without this, `iter` would fall back on `__getitem__` with whole numbers.
    __iter__ = None

    def __getitem__(self, samples) -> "Record":
        if not isinstance(samples, slice) or samples.step not in (None, 1):
            raise ValueError(f"record[{samples!r}]: give a range of samples without a step, record[i:j].")
        first, last, _ = samples.indices(self.samples)
        if last - first < 2:
            raise ValueError(
                f"record[{samples.start}:{samples.stop}] leaves {max(0, last - first)} of {self.samples} "
                "samples; a record needs at least 2."
            )
        start = self.start_time + first * self.sampling_time
        return replace(
            self,
            u=self.u[first:last],
            y=self.y[first:last],
            scheduling=None if self.scheduling is None else self.scheduling[first:last],
            start_time=start,
            stamps=None if self.stamps is None else self.stamps.between(first, last),
        )

    def between(self, start: float | None = None, stop: float | None = None) -> "Record":
        """The samples with start ≤ time < stop.

        **Arguments:**

        - `start`: in s on the record's own clock; default its first sample.
        - `stop`: in s on the record's own clock; default its end.

        **Returns:** a `Record`.

        **Raises:** `ValueError` where fewer than two samples are left.
        """

        # The millionth of a sample forgives times that were written as rounded decimals.
        def index(time, default):
            if time is None:
                return default
            position = (float(time) - self.start_time) / self.sampling_time
            return int(np.clip(np.ceil(position - 1e-6), 0, self.samples))

        first, last = index(start, 0), index(stop, self.samples)
        if last - first < 2:
            raise ValueError(
                f"between({start}, {stop}) leaves {max(0, last - first)} samples; the record runs from "
                f"{self.start_time:g} to {self.start_time + self.duration:g} s."
            )
        return self[first:last]

    def split(self, fraction: float = 0.3) -> tuple["Record", "Record"]:
        """Hold out the last part.

        **Arguments:**

        - `fraction`: share of the samples to hold out, between 0 and 1; default 0.3.

        **Returns:** the estimation `Record` and the held-out validation `Record`.

        **Raises:** `ValueError` where either part would have fewer than two samples.
        """
        if not 0.0 < fraction < 1.0:
            raise ValueError(f"fraction is {fraction}; give the held-out share, between 0 and 1.")
        first = self.samples - round(self.samples * fraction)
        if min(first, self.samples - first) < 2:
            raise ValueError(
                f"fraction {fraction} splits {self.samples} samples into {first} and "
                f"{self.samples - first}; each part needs at least 2."
            )
        return self[:first], self[first:]

    def detrend(self, kind: str = "constant", *, inputs: bool = True, outputs: bool = True) -> "Record":
        """Take the mean or the straight line out of every channel, missing samples ignored.

        **Arguments:**

        - `kind`: `"constant"` (default) or `"linear"`.
        - `inputs`: whether the inputs are treated; default True.
        - `outputs`: whether the outputs are treated; default True.

        **Returns:** a `Record`.

        **Raises:** `ValueError` for another kind.
        """
        if kind not in ("constant", "linear"):
            raise ValueError(f"kind is {kind!r}; give 'constant' or 'linear'.")
        degree = 0 if kind == "constant" else 1
        u = without_trend(self.u, degree) if inputs else self.u
        y = without_trend(self.y, degree) if outputs else self.y
        if not self.has_own_times:
            return replace(self, u=u, y=y)
        if degree:
            raise ValueError("kind is 'linear'; for rows at times of their own give 'constant'.")
        off = (np.mean(self.u - u, axis=0), np.nanmean(self.y - y, axis=0))
        return replace(self, u=u, y=y, stamps=self.stamps.less(*off))

    def select(self, *, inputs=None, outputs=None) -> "Record":
        """Some of the channels, in the order asked for.

        **Arguments:**

        - `inputs`: names or positions, one or several; default all.
        - `outputs`: names or positions, one or several; default all.

        **Returns:** a `Record`.

        **Raises:** `ValueError` for a channel that is not there.
        """
        i = channel_positions("inputs", inputs, self.input_names)
        j = channel_positions("outputs", outputs, self.output_names)
        return replace(
            self,
            u=self.u[:, i],
            y=self.y[:, j],
            input_names=tuple(self.input_names[k] for k in i),
            output_names=tuple(self.output_names[k] for k in j),
            input_units=tuple(self.input_units[k] for k in i),
            output_units=tuple(self.output_units[k] for k in j),
            measured=tuple(self.measured[k] for k in j),
            stamps=None if self.stamps is None else self.stamps.select(i, j),
        )

    def clean_stretches(self, min_samples: int = 2) -> list[slice]:
        """The stretches without a missing sample, longest first.

        **Arguments:**

        - `min_samples`: shorter stretches are left out; default 2.

        **Returns:** slices for `record[slice]`.
        """
        whole = np.concatenate(([False], ~self.missing.any(axis=1), [False]))
        edges = np.flatnonzero(np.diff(whole.astype(np.int8)))
        stretches = [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= max(2, min_samples)]
        return sorted(stretches, key=lambda s: s.start - s.stop)

    def detect_period(self, tolerance: float = 0.05) -> int | None:
        """The period of the inputs in samples.

        **Arguments:**

        - `tolerance`: largest RMS difference between repeats, as a share of the input's RMS about its mean;
            default 0.05, which admits the noise of a measured input.

        **Returns:** the smallest whole number of samples after which all inputs repeat, None where they do
        not or where the record holds fewer than two periods.
        """
        return find_period(self.u, tolerance)

    def average_periods(self, period_samples: int | None = None, *, skip: int = 0) -> "PeriodAverage":
        """The mean over the periods, which leaves the noise behind.

        **Arguments:**

        - `period_samples`: samples in a period; default what `detect_period` finds.
        - `skip`: leading periods left out, as the transient decays in them; default 0.

        **Returns:** a `PeriodAverage`.

        **Raises:** `ValueError` where there are fewer than two whole periods.
        """
        if self.has_own_times:
            raise ValueError("rows at times of their own have no period in samples; average record.on_grid.")
        if period_samples is None:
            period_samples = self.detect_period()
            if period_samples is None:
                raise ValueError("period_samples is missing and the inputs do not repeat; give the period.")
        if period_samples < 2 or skip < 0 or int(period_samples) != period_samples or int(skip) != skip:
            raise ValueError(
                f"period_samples is {period_samples} and skip is {skip}; give a period of at least 2 "
                "samples and a whole number of periods to skip."
            )
        period, skip = int(period_samples), int(skip)
        periods = self.samples // period - skip
        if periods < 2:
            raise ValueError(
                f"period_samples {period} and skip {skip} leave {max(0, periods)} whole periods of "
                f"{self.samples} samples; averaging needs at least 2."
            )
        rows = slice(skip * period, (skip + periods) * period)
        u, _ = between_periods(self.u[rows], periods)
        y, variance = between_periods(self.y[rows], periods)
        p = None if self.scheduling is None else between_periods(self.scheduling[rows, None], periods)[0][:, 0]
        start = self.start_time + skip * period * self.sampling_time
        variance.setflags(write=False)
        return PeriodAverage(replace(self, u=u, y=y, scheduling=p, start_time=start), variance, periods)

    def __repr__(self) -> str:
        return describe(self)


@dataclass(frozen=True, eq=False)
class PeriodAverage:
    """The mean over the periods of a record, and how much the periods differ.

    **Arguments:**

    - `record`: one averaged period.
    - `noise_variance`: variance of the outputs between periods, for each sample, in squared units; that of
        the average is smaller by the number of periods. NaN where fewer than two periods have the sample.
    - `periods`: number of periods averaged.
    """

    record: Record
    noise_variance: Float[np.ndarray, "samples outputs"]
    periods: int
