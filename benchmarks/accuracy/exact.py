"""Records without noise: M, D, K from the subspace start alone, to 1e-7, over everything that a record can be."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxgray
from jaxgray.identification.initialization.start import physical_model
from jaxgray.identification.setup.options import drive_of
from jaxgray.identification.setup.prediction import Setting
from jaxgray.identification.setup.preparation import prepare, scaling_of
from jaxgray.identification.subspace.filter_bank import pole
from jaxgray.identification.subspace.grid import record_factors
from jaxgray.identification.subspace.input_matrix import fit_to_factor, fit_to_record, unit_drives
from jaxgray.identification.subspace.projection import WEIGHTS, arrange, project
from jaxgray.identification.subspace.realization import ExactMap, realize

from .common import data, in_children

TIME = 0.01
CHOICES = tuple(itertools.product((0.01, 0.03, 0.1, 0.3), (4, 8))) + ((1.0, 4),)
PADDED = 8
MEASURED = {
    "displacement": ("displacement",) * 3,
    "velocity": ("velocity",) * 3,
    "acceleration": ("acceleration",) * 3,
    "mixed": ("acceleration", "displacement", "velocity"),
}


@functools.partial(jax.jit, static_argnames=("inputs", "weight", "order"))
def _projected(factor, a, block_rows, *, inputs, weight, order):
    arranged = arrange(factor, a, block_rows, inputs, PADDED)
    return arranged, project(arranged, weight, order, householder=True)


@eqx.filter_jit
def _realized(arranged, projections, a, signals, setting):
    """The realisation, and the least squares for B₂ both ways."""
    realization = realize(projections, a, setting.measured, ExactMap())
    ways = {"measured": setting.measured, "hold": setting.hold}
    by_record = fit_to_record(realization, signals.u, signals.y, signals.kept, **ways)
    return realization, {"factor": fit_to_factor(unit_drives(realization, **ways), arranged), "record": by_record}


def exact_chunk(n, seed):
    """Relative errors of M, D, K by hold, measured quantity, weight, way of the input matrix, τ and i."""
    table = {}
    for hold in ("zero", "linear"):
        for name, kinds in MEASURED.items():
            if n == 1 and name == "mixed":
                continue
            measured = kinds[:n]
            rng = np.random.default_rng([seed, n])
            truth = data.random_system(rng, n)
            u = data.random_steps(rng, 3000, n, TIME, (0.1, 1.0)) if hold == "zero" else data.smooth_noise(rng, 3000, n)
            x0 = rng.standard_normal(2 * n) * np.repeat([0.01, 0.1], n)
            y = data.simulate(*truth, u, TIME, hold=hold, measured=measured, x0=x0) + 0.01
            record = jaxgray.Record(u, y, TIME, hold=hold, measured=measured)
            scaling = scaling_of([record])
            drive = drive_of(record, "force", None, False)
            drive = drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
            setting = Setting(drive, record.measured, hold)
            signals = prepare(record, scaling)
            taus = sorted({tau for tau, _ in CHOICES})
            poles = pole(jnp.asarray(taus), TIME)
            factors, _ = record_factors([signals], poles, PADDED)
            for weight in WEIGHTS:
                for tau, i in CHOICES:
                    a = poles[taus.index(tau)]
                    rows = jnp.asarray(float(i))
                    arranged, projections = _projected(
                        factors[taus.index(tau)], a, rows, inputs=n, weight=WEIGHTS[weight], order=2 * n
                    )
                    realization, fits = _realized(arranged, projections, a, signals, setting)
                    for way, fit in fits.items():
                        try:
                            found = scaling.matrices_out(*physical_model(realization, fit, setting, None))
                            worst = float(np.max(data.relative_errors(found, truth)))
                        except jaxgray.ComputationError as error:
                            print(n, hold, name, weight, way, tau, i, error, flush=True)
                            worst = np.inf
                        table[n, hold, name, weight, way, tau, i] = worst if np.isfinite(worst) else np.inf
    return table


def row_exact(seeds):
    """No noise, start in motion, offset 0.01: n = 1, 2, 3, both holds, every quantity, weight and way, τ and i."""
    table = {}
    for n, part in zip((1, 2, 3), in_children(exact_chunk, [(n, seeds.start) for n in (1, 2, 3)])):
        table |= part
        errors = np.array(list(part.values()))
        over = {case: error for case, error in part.items() if not error < 1e-7}
        print(
            f"n = {n}: {len(errors)} cases, median {np.median(errors):.1e}, worst {errors.max():.1e}, "
            f"{len(over)} above 1e-7",
            flush=True,
        )
        for case, error in sorted(over.items(), key=lambda item: -item[1])[:40]:
            print("   ", *case[1:], f"{error:.1e}", flush=True)
    return {" ".join(map(str, case)): error for case, error in table.items()}
