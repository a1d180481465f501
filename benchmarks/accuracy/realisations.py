"""Many noises on one input, in batches: error over bound, and coverage of the intervals."""

import numpy as np

import jaxgray

from .common import TRUTH, H, bound, data, show


def row_realisations(seeds):
    """One input, 50 noises per seed (1000 by default) in batches: error over bound, and coverage of the intervals."""
    u, _, clean = data.reference_record(0)
    covariance = bound(u)
    truth = np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in TRUTH])
    deviations, standard, alone, failed = [], [], 0, 0
    for part in seeds:
        rng = np.random.default_rng(10_000 + part)
        records = [
            jaxgray.Record(u, clean + data.REFERENCE_NOISE * rng.standard_normal(clean.shape), H) for _ in range(50)
        ]
        found = jaxgray.identify_many(records, time_constants=0.05, block_rows=8)
        alone += int(found.alone.sum())
        failed += int((~found.successful).sum())
        good = found.successful
        matrices = (found.mass, found.damping, found.stiffness)
        deviations.append(np.concatenate([X[:, (0, 0, 1), (0, 1, 1)] for X in matrices], axis=1)[good] - truth)
        standard.append(np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[good])
    deviations, standard = np.concatenate(deviations), np.concatenate(standard)
    twice = np.tile([1.0, 2.0, 1.0], 3)
    squares = (twice * np.mean(deviations**2, axis=0)).reshape(3, 3).sum(axis=1)
    ratio = np.sqrt(squares / (twice * np.diag(covariance)).reshape(3, 3).sum(axis=1))
    covered = 100 * np.mean(np.abs(deviations) < 1.959964 * standard, axis=0)
    show(f"{len(deviations)} realisations: RMS error / bound (bar 0.95 to 1.05)", ratio)
    print(f"    coverage of 95 % intervals, nine entries (bar 93 to 97 %): {covered.round(1).tolist()}")
    print(f"    identified one by one {alone}, failed {failed}", flush=True)
    return {"ratio": ratio, "coverage_percent": covered, "alone": alone, "failed": failed}
