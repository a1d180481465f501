"""What a response says of time and sign: a mechanical one is a sum of modes with real residues.

    G(ω) = (jω)^d H(ω) Σ_r R_r / (ω_r² − ω² + 2jζ_r ω_r ω) e^{−jωτ}

with d the derivative that is measured and H the hold of the input. A shift in time leaves the poles and turns the
residues, each by its own frequency: the shift τ is where they are real. At a driving point all of them are
positive, since a force does work on the mass it pushes (Maia & Silva, Theoretical and Experimental Modal Analysis,
Wiley 1997, §2.4).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxgray.records.checks.answers import Answer

DERIVATIVE = {"displacement": 0, "velocity": 1, "acceleration": 2}

BANDS = 256
MOST_MODES = 5

EXCITED = 1e-3
"""Power of an input, over its largest, from which a frequency counts."""

SHIFTS = 0.5 * np.arange(-160, 161)
"""Shifts that are tried, in samples."""


@dataclass(frozen=True, eq=False)
class Modes:
    """One output as a sum of modes.

    **Arguments:**

    - `share`: unexplained share of the answer.
    - `shift`: τ in samples at which residues are real; `misfit`: share of the power left there; `unshifted`: likewise
      at no shift; `misfits`: at all of `SHIFTS`, infinite beyond about half a period.
    - `omega`: natural frequencies in rad per sample, the strongest first.
    - `parts`: RMS of what each mode brings over that of all, with the sign of its residue; `turned`: likewise beside
      what turns its phase, as dampers that couple the modes do; `left`: share of the power that this leaves.
    """

    share: float
    shift: float
    misfit: float
    unshifted: float
    misfits: Float[np.ndarray, " shifts"]
    omega: Float[np.ndarray, " modes"]
    parts: Float[np.ndarray, "inputs modes"]
    turned: Float[np.ndarray, "inputs modes"]
    left: float


def input_power(u: Float[np.ndarray, "samples inputs"]) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in cycles per sample, and the mean power of every input in bands around them."""
    power = np.abs(np.fft.rfft(u * np.hanning(len(u))[:, None], axis=0)) ** 2
    band = np.minimum((2 * BANDS * np.fft.rfftfreq(len(u))).astype(int), BANDS - 1)
    counts = np.maximum(np.bincount(band, minlength=BANDS), 1)
    mean = np.stack([np.bincount(band, column, BANDS) for column in power.T]) / counts
    return (np.arange(BANDS) + 0.5) / (2 * BANDS), mean


def modes(found: Answer, power: tuple[np.ndarray, np.ndarray], measured: str, hold: str, lead: int = 0) -> Modes | None:
    """Modes of one output, and the shift at which their residues are real.

    **Arguments:** `found`: its `Answer` to inputs that were put off by `lead` samples; `power`: of `input_power`;
    `measured`; `hold`.

    **Returns:** None where no mode is seen.
    """
    grid, power_of = power
    z = np.roots(found.a)
    s = np.log(z[(z.imag > 1e-3) & (np.abs(z) < 1.1)])
    omega, zeta = np.abs(s), np.maximum(-s.real / np.abs(s), 1e-4)
    excited = np.max([np.interp(omega / (2 * np.pi), grid, P) > EXCITED * P.max() for P in power_of], axis=0)
    inside = (zeta < 0.8) & (omega < 0.95 * np.pi) & excited
    omega, zeta = omega[inside], zeta[inside]
    if omega.size == 0:
        return None
    near = omega[:, None] / (2 * np.pi) * (1.0 + zeta[:, None] * np.array([-3.0, -1.5, -0.7, 0.0, 0.7, 1.5, 3.0]))
    f = np.unique(np.concatenate([grid, near.ravel()]))
    f = f[(f > 0.0) & (f < 0.49)]
    back = np.exp(-2j * np.pi * f)
    states, rows = _states(omega, zeta, f, hold), DERIVATIVE[measured]
    basis, turning = states[rows : rows + 2]
    # What stiffer modes add has settled when the next sample is taken.
    rest = [back[:, None]] if rows == 0 else []
    A = np.polynomial.polynomial.polyval(back, found.a)
    spacing = np.gradient(f)
    pairs = []
    for b, P in zip(found.b, power_of):
        S = np.interp(f, grid, P)
        weight = np.sqrt(np.where(S > EXCITED * P.max(), S, 0.0) * spacing)
        kept = weight > 0.0
        G = np.polynomial.polynomial.polyval(back, b) / A / back**lead
        pairs.append((kept, weight[kept], (weight * G)[kept]))
    whole = sum(float(np.sum(np.abs(t) ** 2)) for _, _, t in pairs)
    if whole == 0.0:
        return None

    turned = []
    for kept, weight, t in pairs:
        moved = t[:, None] * np.exp(2j * np.pi * np.outer(f[kept], SHIFTS))
        turned.append((kept, weight[:, None], np.concatenate([moved.real, moved.imag]), np.sum(np.abs(t) ** 2)))

    def projected(columns):
        """Share of power that the columns leave, by real factors, at each shift; and the factors."""
        left, factors = np.zeros(len(SHIFTS)), []
        for kept, weight, target, power in turned:
            X = weight * columns[kept]
            Q, R = np.linalg.qr(np.concatenate([X.real, X.imag]))
            along = Q.T @ target
            left += power - np.sum(along**2, axis=0)
            factors.append((R, along, np.linalg.norm(X, axis=0)))
        return np.maximum(left, 0.0) / whole, factors

    # The modes that matter, whatever their phases.
    chosen, before = [], 1.0
    for _ in range(MOST_MODES):
        others = [r for r in range(len(omega)) if all(abs(omega[r] / omega[k] - 1.0) > APART for k in chosen)]
        if not others:
            break
        tried = [
            np.min(projected(np.hstack([basis[:, some], turning[:, some], *rest]))[0])
            for r in others
            for some in [[*chosen, r]]
        ]
        best = int(np.argmin(tried))
        if tried[best] > 0.7 * before:
            break
        chosen.append(others[best])
        before = tried[best]
        if before < 1e-4:
            break
    if not chosen:
        return None
    # Half a period on, a single mode looks like itself with the other sign.
    outside = np.abs(SHIFTS) > 1.2 * np.pi / omega[chosen[0]]
    real = projected(np.hstack([basis[:, chosen], *rest]))
    free = projected(np.hstack([basis[:, chosen], turning[:, chosen], *rest]))
    left, factors = next((one for one in (real, free) if np.min(one[0][~outside]) < REAL), free)
    misfits = np.where(outside, np.inf, left)
    best = int(np.argmin(misfits))

    def parts(factors):
        found = [np.linalg.lstsq(R, along[:, best], rcond=1e-12)[0] * size for R, along, size in factors]
        return np.array(found)[:, : len(chosen)] / np.sqrt(whole)

    return Modes(
        found.share,
        float(SHIFTS[best]),
        float(misfits[best]),
        float(misfits[np.argmin(np.abs(SHIFTS))]),
        misfits,
        omega[chosen],
        parts(factors),
        parts(free[1]),
        float(free[0][best]),
    )


REAL = 0.05
"""Misfit up to which residues count as real; beyond, dampers couple the modes and their phases are free: then only a
band of several modes tells a shift."""


APART = 0.04
"""Relative distance of two natural frequencies below which a long equation has split one mode."""


def _states(omega: np.ndarray, zeta: np.ndarray, f: np.ndarray, hold: str) -> list[np.ndarray]:
    """Displacement and its first three derivatives, of unit masses by unit forces, frequencies × modes: exact samples
    for a force that is constant in between, otherwise as for one that has no more than these frequencies."""
    jw = 2j * np.pi * f[:, None]
    if hold != "zero":
        q = np.sinc(f[:, None]) ** 2 / (omega**2 + jw**2 + 2.0 * zeta * omega * jw)
        return [q, jw * q, jw**2 * q, jw**3 * q]
    z = np.exp(jw)
    sigma, damped = zeta * omega, omega * np.sqrt(1.0 - zeta**2)
    decay, c, s = np.exp(-sigma), np.cos(damped), np.sin(damped) / damped
    a11, a12 = decay * (c + sigma * s), decay * s
    a21, a22 = -(omega**2) * a12, decay * (c - sigma * s)
    b1, b2 = (1.0 - a11) / omega**2, a12
    determinant = (z - a11) * (z - a22) - a12 * a21
    q = ((z - a22) * b1 + a12 * b2) / determinant
    v = (a21 * b1 + (z - a11) * b2) / determinant
    a = 1.0 - omega**2 * q - 2.0 * sigma * v
    return [q, v, a, -(omega**2) * v - 2.0 * sigma * a]
