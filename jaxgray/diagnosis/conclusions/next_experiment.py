"""The next experiment: the input that best separates models which the record at hand does not."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ...identification.refinement.conic import pseudo_inverse
from ...numerics.matrices.bounded import bounded
from ...numerics.progress import AbstractProgress
from ...records import Record
from .. import settings
from ..estimation.context import SearchContext
from ..findings import NextExperiment
from ..model.candidate import Candidate, Data

ROUNDS = 2
CHILDREN = 6
"""Variations of the best input that are tried in each round."""

SHORTEST, LONGEST = 1000, 8192
"""Samples that an experiment has at least, if the record has as many, and at most."""


def next_experiment(
    context: SearchContext,
    members: list[Candidate],
    ids: tuple[str, ...],
    record: Record,
    floor: Float[np.ndarray, " outputs"],
    *,
    progress: AbstractProgress,
) -> NextExperiment | None:
    """The input, within the amplitude and band of the record, that best separates the members of a class.

    Inputs of several families (steps fast and slow, multisines, a chirp, at full and half amplitude) are simulated with
    every member; the best is varied and tried again. The separation is what refitting one member to the other's
    outputs would leave, to first order:

        d² = min_δ ‖(y_i − y_j − J_i δ)/σ‖².

    **Arguments:** `context`; `members`: the class, refitted; `ids` of the laws in which they differ; `record`: whose
    amplitude and band are kept, and its length up to `LONGEST`, or that of a shorter held-out one; `floor`: noise σ
    per output; `progress`.

    **Returns:** a `NextExperiment`, or None where the members cannot be simulated, or no input separates them, or none
    does so better than the record.

    **Reference:** Hunter & Reiner (1965), designs for discriminating between two rival models.
    """
    rng = context.rng
    now = separation(context, members, context.data[0], floor)
    if now is None:
        return None
    long_enough = [d for d in context.validation if d.samples >= SHORTEST]
    data = min((context.data[0], *long_enough), key=lambda d: d.samples)
    data = data if data.samples <= LONGEST else data.part(0, LONGEST)
    data = dataclasses.replace(data, kept=np.arange(len(data.u))[:, None] < np.full(len(floor), data.samples))
    tried = []
    for k, (name, u) in enumerate(inputs_like(record, data.samples, rng)):
        progress.stage("designing the next experiment", fraction=k / 20)
        d = separation(context, members, _with_input(data, u), floor)
        if d is not None:
            tried.append((d, name, u))
    if not tried:
        return None
    best = max(tried, key=lambda item: item[0])
    peak = np.max(np.abs(record.u), axis=0)
    for _ in range(ROUNDS):
        for u in _children(best[2], peak, rng):
            progress.stage("designing the next experiment")
            d = separation(context, members, _with_input(data, u), floor)
            if d is not None and d > best[0]:
                best = d, best[1], u
    d, name, u = best
    if d < max(settings.SEPARATION, settings.MIN_SEPARATION_RATIO * now):
        # Nothing within the amplitude and band of the record tells them apart, or not any better.
        return None
    # Where the noise has a colour, or follows the motion, a record tells less than its samples promise.
    enough = "; 9 is enough where the noise is white" if now < settings.SEPARATION else ", where it was not enough"
    text = (
        f"{name[0].upper()}{name[1:]}, {data.samples} samples at {record.sampling_time:g} s, within the amplitude of "
        f"the record: predicted to separate {' and '.join(ids)} by d² = {d:.0f} (this record: {now:.1f}{enough})."
    )
    return NextExperiment(ids, u, record.sampling_time, float(d), float(now), text)


def separation(context: SearchContext, members: list[Candidate], data: Data, floor) -> float | None:
    """The least d² between the first member and any other; None where one overflows."""
    first = Candidate(members[0].entries, (np.zeros(len(members[0].x0[0])),), members[0].terms)
    simulator = context.simulator.coarse
    y, J = simulator.run_and_jacobian(first, data)
    if not bounded(y, J):
        return None
    scale = np.where(data.kept[:, :, None], 1 / floor[None, :, None], 0.0)
    table = (J * scale).reshape(-1, J.shape[2])
    if not bounded(table):
        return None
    inverse = pseudo_inverse(table.T @ table)
    least = None
    for other in members[1:]:
        still = Candidate(other.entries, (np.zeros(len(other.x0[0])),), other.terms)
        run = simulator.run(still, data)
        if not bounded(run):
            return None
        e = ((run - y) * scale[:, :, 0]).reshape(-1)
        if not bounded(e):
            return None
        across = table.T @ e
        d = float(e @ e - across @ inverse @ across)
        least = d if least is None else min(least, d)
    return least


def _with_input(data: Data, u: np.ndarray) -> Data:
    padded = np.pad(u, ((0, len(data.u) - len(u)), (0, 0)), mode="edge")
    return dataclasses.replace(data, u=padded)


def inputs_like(record: Record, samples: int, rng: np.random.Generator):
    """Inputs of several families with the peak and upper band of a record: pairs of name and input."""
    inputs, h = record.inputs, record.sampling_time
    peak = np.max(np.abs(record.u), axis=0)
    power = np.sum(np.abs(np.fft.rfft(record.u - record.u.mean(axis=0), axis=0)) ** 2, axis=1)
    share = np.cumsum(power) / max(power.sum(), 1e-300)
    frequency = np.fft.rfftfreq(record.samples, h)
    n = samples
    highest = max(float(frequency[np.searchsorted(share, 0.95)]), 4.0 / (n * h))
    result = []
    for factor in (1.0, 0.4):
        for slow in (0.5, 2.0, 8.0):
            u = np.stack([_steps(rng, n, slow / (highest * h)) for _ in range(inputs)], axis=1)
            result.append((f"random steps of about {slow / highest:.2g} s", factor * peak * u))
        for upper in (highest, highest / 4):
            u = np.stack([_multisine(rng, n, h, upper) for _ in range(inputs)], axis=1)
            result.append((f"a multisine up to {upper:.3g} Hz", factor * peak * u))
    select_forward = np.linspace(0.1, 1.0, n)[:, None]
    u = np.stack([_multisine(rng, n, h, highest) for _ in range(inputs)], axis=1)
    result.append((f"a multisine up to {highest:.3g} Hz of growing amplitude", peak * select_forward * u))
    u = np.stack([_steps(rng, n, 2.0 / (highest * h)) for _ in range(inputs)], axis=1)
    result.append(("random steps of growing amplitude", peak * select_forward * u))
    t = np.arange(n) * h
    phase = 2 * np.pi * (0.02 * highest * t + 0.5 * (highest - 0.02 * highest) * t**2 / (n * h))
    result.append(
        (f"a chirp up to {highest:.3g} Hz", peak * np.stack([np.sin(phase + k) for k in range(inputs)], axis=1))
    )
    return result


def _steps(rng, n, mean_hold):
    u = np.empty(n)
    k = 0
    while k < n:
        length = max(1, int(rng.uniform(0.5, 1.5) * mean_hold))
        u[k : k + length] = rng.uniform(-1, 1)
        k += length
    return u / max(np.max(np.abs(u)), 1e-300)


def _multisine(rng, n, h, highest):
    lines = np.arange(1, max(2, int(highest * n * h)) + 1)
    spectrum = np.zeros(n // 2 + 1, complex)
    lines = lines[lines < len(spectrum)]
    spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    u = np.fft.irfft(spectrum, n)
    return u / np.max(np.abs(u))


def _children(u, peak, rng):
    """Variations: phases of the spectrum stirred, amplitude bent over time, all within the peak."""
    n = len(u)
    for k in range(CHILDREN):
        if k % 2:
            spectrum = np.fft.rfft(u, axis=0)
            new = np.fft.irfft(spectrum * np.exp(0.5j * rng.standard_normal(spectrum.shape)), n, axis=0)
        else:
            ends = rng.uniform(0.2, 1.0, 6)
            new = u * np.interp(np.arange(n), np.linspace(0, n, 6), ends)[:, None]
        largest = np.max(np.abs(new), axis=0)
        yield new * (peak / np.where(largest > 0, largest, 1.0))
