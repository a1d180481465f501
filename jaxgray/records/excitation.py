"""Inputs worth applying: random steps, PRBS, multisine, chirp, white noise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


def random_steps(
    samples: int,
    channels: int = 1,
    sampling_time: float = 1.0,
    *,
    hold_times: tuple[float, float] = (0.5, 3.0),
    amplitude: float = 1.0,
    rng: np.random.Generator | int = 0,
) -> Float[np.ndarray, "samples channels"]:
    """Steps between −amplitude and +amplitude, independent in every channel, held for random times.

    **Arguments:**

    - `samples`: length.
    - `channels`: number of inputs; default 1.
    - `sampling_time`: in s; default 1.
    - `hold_times`: shortest and longest time in s between steps, uniform in between; default 0.5 to 3.
    - `amplitude`: in the unit of the input; default 1.
    - `rng`: generator or seed; default 0.

    **Returns:** the input.

    **Raises:** `ValueError` where an argument does not fit.
    """
    _check(samples, channels, sampling_time)
    shortest, longest = hold_times
    if not 0.0 < shortest <= longest < np.inf:
        raise ValueError(f"hold_times is {hold_times}; give a shortest and a longest time in s, both positive.")
    rng = np.random.default_rng(rng)
    u = np.empty((samples, channels))
    # Rounding can shorten a hold by half a sample, but to no less than one.
    shortest_samples = max(1, int(np.rint(shortest / sampling_time)))
    count = -(-samples // shortest_samples)
    for c in range(channels):
        holds = np.maximum(1, np.rint(rng.uniform(shortest, longest, count) / sampling_time).astype(int))
        signs = rng.choice([-1.0, 1.0]) * (-1.0) ** np.arange(count)
        u[:, c] = amplitude * np.resize(np.repeat(signs, holds), samples)
    return u


def prbs(
    samples: int,
    channels: int = 1,
    sampling_time: float = 1.0,
    *,
    clock_period: float | None = None,
    order: int | None = None,
    amplitude: float = 1.0,
) -> Float[np.ndarray, "samples channels"]:
    """A pseudo-random binary sequence from a maximum-length shift register of 2^order − 1 clock periods.

    Channels are the same sequence, shifted by equal parts of its period, and so all but uncorrelated.

    **Arguments:**

    - `samples`: length.
    - `channels`: number of inputs; default 1.
    - `sampling_time`: in s; default 1.
    - `clock_period`: time in s for which a value is held, a whole number of samples; default one sample.
    - `order`: bits of the register, 2 to 32; default the least whose period covers the record.
    - `amplitude`: in the unit of the input; default 1.

    **Returns:** the input, −amplitude or +amplitude.

    **Raises:** `ValueError` where an argument does not fit.
    """
    from scipy.signal import max_len_seq

    _check(samples, channels, sampling_time)
    held = 1 if clock_period is None else round(clock_period / sampling_time)
    if held < 1 or (clock_period is not None and abs(held * sampling_time - clock_period) > 1e-6 * clock_period):
        raise ValueError(
            f"clock_period is {clock_period} s; give a whole number of sampling times of {sampling_time} s."
        )
    clocks = -(-samples // held)
    if order is None:
        order = max(2, int(np.ceil(np.log2(clocks + 1))))
    if not 2 <= order <= 32:
        raise ValueError(f"order is {order}; give 2 to 32 bits.")
    period = 2**order - 1
    sequence = 2.0 * max_len_seq(order)[0] - 1.0
    u = np.empty((samples, channels))
    for c in range(channels):
        shifted = np.resize(np.roll(sequence, -(c * period // channels)), clocks)
        u[:, c] = amplitude * np.repeat(shifted, held)[:samples]
    return u


@dataclass(frozen=True, eq=False)
class Multisine:
    """A multisine and its lines.

    **Arguments:**

    - `signal`: the input `(samples, channels)`.
    - `period_samples`: samples in a period.
    - `excited_lines`: multiples of the base frequency that are excited.
    - `detection_lines`: odd multiples inside the band that are left out, where odd distortion shows; the even
        ones show even distortion.
    - `base_frequency_hz`: one over the period.
    """

    signal: Float[np.ndarray, "samples channels"]
    period_samples: int
    excited_lines: Int[np.ndarray, " lines"]
    detection_lines: Int[np.ndarray, " detection"]
    base_frequency_hz: float


def multisine(
    samples: int,
    channels: int = 1,
    sampling_time: float = 1.0,
    *,
    band_hz: tuple[float, float] | None = None,
    period_samples: int | None = None,
    kind: str = "random_phase",
    odd: bool = True,
    detection_lines: int = 4,
    amplitude: float = 1.0,
    rng: np.random.Generator | int = 0,
) -> Multisine:
    """A sum of sines on multiples of one frequency,

        u(t) = A sqrt(2/n) Σ_k cos(2π k f₀ t + φ_k).

    Random phases are independent in every channel. Schroeder phases φ_k = −π j (j − 1)/m of the j-th of m
    lines in the band give a low crest factor; channels are then shifted by equal parts of half a period.

    **Arguments:**

    - `samples`: length.
    - `channels`: number of inputs; default 1.
    - `sampling_time`: in s; default 1.
    - `band_hz`: lowest and highest frequency; default from the base frequency to 0.4 of the sampling rate.
    - `period_samples`: samples in a period; default `samples`.
    - `kind`: `"random_phase"` (default) or `"schroeder"`.
    - `odd`: whether only odd lines are excited; default True.
    - `detection_lines`: one line at random out of each group of so many is left out, 0 for none; default 4.
    - `amplitude`: RMS in the unit of the input; default 1.
    - `rng`: generator or seed; default 0.

    **Returns:** a `Multisine`.

    **Raises:** `ValueError` where an argument does not fit.
    """
    _check(samples, channels, sampling_time)
    period = samples if period_samples is None else int(period_samples)
    if not 4 <= period <= samples:
        raise ValueError(f"period_samples is {period}; give 4 to {samples} samples.")
    if kind not in ("random_phase", "schroeder"):
        raise ValueError(f"kind is {kind!r}; give 'random_phase' or 'schroeder'.")
    if detection_lines != 0 and detection_lines < 2:
        raise ValueError(f"detection_lines is {detection_lines}; give 0 or the size of a group, at least 2.")
    base = 1.0 / (period * sampling_time)
    low, high = _band(band_hz, sampling_time) if band_hz is not None else (base, 0.4 / sampling_time)
    first = max(1, int(np.ceil(low / base - 1e-9)))
    last = min((period - 1) // 2, int(np.floor(high / base + 1e-9)))
    lines = np.arange(first, last + 1)
    if odd:
        lines = lines[lines % 2 == 1]
    if lines.size == 0:
        raise ValueError(
            f"band_hz {low:g} to {high:g} Hz holds no line of the base frequency {base:g} Hz; widen the "
            "band or lengthen the period."
        )
    rng = np.random.default_rng(rng)
    detection = np.empty(0, dtype=int)
    if detection_lines:
        groups = lines[: len(lines) // detection_lines * detection_lines].reshape(-1, detection_lines)
        detection = groups[np.arange(len(groups)), rng.integers(0, detection_lines, len(groups))]
    excited = np.setdiff1d(lines, detection)

    n = len(excited)
    spectrum = np.zeros((period // 2 + 1, channels), dtype=complex)
    if kind == "random_phase":
        phase = rng.uniform(0.0, 2.0 * np.pi, (n, channels))
    else:
        # Counted over all lines of the band: left-out ones keep their place in the sweep.
        j = np.searchsorted(lines, excited)[:, None] + 1
        # Parts of half a period: half a period itself turns an odd multisine into its negative.
        shift = np.pi * excited[:, None] * np.arange(channels) / channels
        phase = -np.pi * j * (j - 1) / len(lines) - shift
    spectrum[excited] = np.exp(1j * phase)
    one = np.fft.irfft(spectrum, period, axis=0) * period * amplitude / np.sqrt(2.0 * n)
    signal = np.resize(one, (samples, channels))
    return Multisine(signal, period, excited, detection, base)


def chirp(
    samples: int,
    channels: int = 1,
    sampling_time: float = 1.0,
    *,
    band_hz: tuple[float, float],
    logarithmic: bool = True,
    amplitude: float = 1.0,
) -> Float[np.ndarray, "samples channels"]:
    """A sine whose frequency sweeps once through a band; every other channel lags by π over their number.

    **Arguments:**

    - `samples`: length.
    - `channels`: number of inputs; default 1.
    - `sampling_time`: in s; default 1.
    - `band_hz`: first and last frequency; the first may be the higher one.
    - `logarithmic`: whether each octave takes the same time, otherwise each hertz does; default True.
    - `amplitude`: in the unit of the input; default 1.

    **Returns:** the input.

    **Raises:** `ValueError` where an argument does not fit.
    """
    _check(samples, channels, sampling_time)
    falling = band_hz[0] > band_hz[1]
    low, high = _band(band_hz[::-1] if falling else band_hz, sampling_time)
    first, last = (high, low) if falling else (low, high)
    t, duration = sampling_time * np.arange(samples), sampling_time * samples
    if logarithmic:
        rate = np.log(last / first) / duration
        phase = 2.0 * np.pi * first * np.expm1(rate * t) / rate
    else:
        phase = 2.0 * np.pi * (first * t + (last - first) * t**2 / (2.0 * duration))
    return amplitude * np.sin(phase[:, None] - np.pi * np.arange(channels) / channels)


def white(
    samples: int,
    channels: int = 1,
    sampling_time: float = 1.0,
    *,
    band_hz: tuple[float, float] | None = None,
    amplitude: float = 1.0,
    rng: np.random.Generator | int = 0,
) -> Float[np.ndarray, "samples channels"]:
    """Gaussian noise, independent in every channel, white or white inside a band.

    **Arguments:**

    - `samples`: length.
    - `channels`: number of inputs; default 1.
    - `sampling_time`: in s; default 1.
    - `band_hz`: lowest and highest frequency; default all.
    - `amplitude`: standard deviation in the unit of the input; default 1.
    - `rng`: generator or seed; default 0.

    **Returns:** the input.

    **Raises:** `ValueError` where an argument does not fit.
    """
    _check(samples, channels, sampling_time)
    u = np.random.default_rng(rng).standard_normal((samples, channels))
    if band_hz is not None:
        low, high = _band(band_hz, sampling_time)
        frequency = np.fft.rfftfreq(samples, sampling_time)
        inside = (frequency >= low) & (frequency <= high)
        if not inside.any():
            raise ValueError(f"band_hz {low:g} to {high:g} Hz is narrower than one line; widen it.")
        u = np.fft.irfft(np.fft.rfft(u, axis=0) * inside[:, None], samples, axis=0)
        # Every line but the first and, for even lengths, the last stands for two frequencies.
        weight = np.full(len(frequency), 2.0)
        weight[0], weight[-1] = 1.0, 2.0 if samples % 2 else 1.0
        u *= np.sqrt(samples / np.sum(weight[inside]))
    return amplitude * u


def _check(samples: int, channels: int, sampling_time: float) -> None:
    if samples < 2 or channels < 1 or not 0.0 < sampling_time < np.inf:
        raise ValueError(
            f"samples {samples}, channels {channels}, sampling_time {sampling_time}; give at least 2 "
            "samples, 1 channel and a positive time in s."
        )


def _band(band_hz: tuple[float, float], sampling_time: float) -> tuple[float, float]:
    low, high = band_hz
    if not 0.0 < low < high <= 0.5 / sampling_time * (1.0 + 1e-9):
        raise ValueError(
            f"band_hz is {band_hz}; give two different positive frequencies up to half the sampling rate, "
            f"{0.5 / sampling_time:g} Hz."
        )
    return float(low), float(high)
