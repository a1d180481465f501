"""64 time constants × 9 block-row counts: mass, damping and stiffness of every choice, beside NumPy and SciPy.

    python benchmarks/sweep_speed.py [--time-constants 64] [--repeats 3] [--json OUT]

The peer is the same algorithm written as a loop: `lfilter` for the Laguerre family, a Gram matrix with Cholesky
for the factor, then the projections, the realisation, the input matrix and the physical matrices of every choice. It is
timed with one factor per time constant, shared by all block rows, and with a factor of its own for every choice (on
every eighth time constant, the time scaled up). Both sides are given the same two cores. What they find is compared.
"""

import argparse
import json
import os
import pathlib
import sys
import time

os.environ["OPENBLAS_NUM_THREADS"] = str(os.cpu_count())
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np
import scipy.linalg
import scipy.signal

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.identification.initialization.physical_grid import physical_grid  # noqa: E402
from jaxgray.identification.setup.prediction import Setting  # noqa: E402
from jaxgray.identification.setup.preparation import prepare, scaling_of  # noqa: E402
from jaxgray.identification.subspace.compression import factors  # noqa: E402
from jaxgray.identification.subspace.filter_bank import pole  # noqa: E402
from jaxgray.identification.subspace.grid import candidates, record_factors  # noqa: E402
from jaxgray.identification.subspace.projection import MOESP  # noqa: E402
from jaxgray.identification.subspace.realization import ExactMap  # noqa: E402
from jaxgray.mechanics.systems.drives import Force  # noqa: E402

H = data.REFERENCE_TIME
ROWS = tuple(range(4, 13))


def loop_factor(u, y, tau, block_rows):
    """Triangular factor of the Laguerre family of all channels, first state and offsets taken out; inputs first."""
    a = np.exp(-H / tau)
    signals = np.concatenate([u, y], axis=1)
    impulse = np.zeros(len(u) + 1)
    impulse[0] = 1.0
    first, filtered = [], [signals]
    x = scipy.signal.lfilter([0.0, np.sqrt(1 - a * a)], [1.0, -a], signals, axis=0)
    r = scipy.signal.lfilter([0.0, np.sqrt(1 - a * a)], [1.0, -a], impulse)
    for k in range(2 * block_rows - 1):
        filtered.append(x)
        first.append(r[1:])
        if k < 2 * block_rows - 2:
            x = scipy.signal.lfilter([-a, 1.0], [1.0, -a], x, axis=0)
            r = scipy.signal.lfilter([-a, 1.0], [1.0, -a], r)
    inputs = u.shape[1]
    nuisance = np.stack([*first, np.ones(len(u))], axis=1)
    rows = np.concatenate([nuisance, *(f[:, :inputs] for f in filtered), *(f[:, inputs:] for f in filtered)], axis=1)
    gram = rows.T @ rows
    size = np.sqrt(np.diag(gram))
    R = scipy.linalg.cholesky(gram / size[:, None] / size) * size
    R = R[2 * block_rows :, 2 * block_rows :]
    count = 2 * block_rows * inputs
    return a, R[:, :count].reshape(-1, 2 * block_rows, inputs), R[:, count:].reshape(-1, 2 * block_rows, y.shape[1])


def shift(a, size):
    S = np.zeros((size, size + 1))
    k = np.arange(size)
    S[k, k], S[k, k + 1] = a / (1 + a), 1 / (1 + a)
    S[0, 0], S[0, 1] = 0.0, np.sqrt((1 - a) / (1 + a))
    return S


def past_rows(a, rows, shifts):
    found = np.eye(rows)
    for _ in range(shifts):
        found = np.linalg.qr((found @ shift(a, found.shape[1])).T)[0].T
    return found


def loop_choice(a, U, Y, i, E):
    """M, D, K of one choice from the factor (time in samples, scaled channels, E the scaled input map)."""
    rows, _, m = U.shape
    p = Y.shape[2]
    n = 2 * p

    def flat(X):
        return X.reshape(rows, -1)

    def spans(fewer, past):
        ahead = np.arange(rows) < (i - fewer) * m
        inputs = np.arange(rows) < 2 * i * m
        off = flat(past).copy()
        off[inputs] = 0.0
        return ahead, inputs & ~ahead, np.linalg.qr(off)[0] * ~inputs[:, None]

    def on_past(span, X):
        return X * span[1][:, None] + span[2] @ (span[2].T @ X)

    Ypast = np.einsum("rj,qjc->qrc", past_rows(a, i, i), Y[:, : 2 * i])
    Ymore = np.einsum("rj,qjc->qrc", past_rows(a, i + 1, i - 1), Y[:, : 2 * i])
    span, later = spans(0, Ypast), spans(1, Ymore)
    Yf, Yshort = flat(Y[:, :i]), flat(Y[:, : i - 1])
    coefficients = np.concatenate([(Yf * span[1][:, None]).T, Yf.T @ span[2]], axis=1)
    basis = np.linalg.svd(coefficients, full_matrices=False)[2][:n].T
    G = coefficients @ basis
    G = G / np.linalg.norm(G, axis=0)
    S = shift(a, i - 1)
    Gs = np.einsum("kj,jpn->kpn", S, G.reshape(i, p, n)).reshape(-1, n)
    states = on_past(span, Yf @ np.linalg.pinv(G).T)
    ahead = Yshort @ np.linalg.pinv(Gs).T
    ahead = on_past(later, ahead) + ahead * later[0][:, None]
    power = np.eye(1, i)
    square = shift(a, i)[:, :i]
    for _ in range(i - 1):
        power = power @ square
    now = np.einsum("j,qjc->qc", power[0], Y[:, :i])
    targets = np.concatenate([ahead, now], axis=1) * ~span[0][:, None]
    solution = np.linalg.lstsq(states, targets, rcond=None)[0].T
    A = scipy.linalg.logm(a * np.eye(n) + (1 - a) * solution[:n]).real
    C = solution[n:]
    T = np.concatenate([C, C @ A])
    lower = np.linalg.solve(T.T, (C @ A @ A).T).T
    A21, A22 = lower[:, :p], lower[:, p:]
    A = np.block([[np.zeros((p, p)), np.eye(p)], [A21, A22]])

    flow = scipy.linalg.expm(np.block([[A, np.eye(n)[:, p:]], [np.zeros((p, n + p))]]))
    Ad, Bd, C = flow[:n, :n], flow[:n, n:], np.eye(p, n)
    eye = np.eye(n)
    ratio = np.linalg.solve((eye - a * Ad).T, (Ad - a * eye).T).T
    drive = np.linalg.solve(eye - a * Ad, Bd)
    root = np.sqrt((1 - a) / (1 + a))
    count = 2 * U.shape[1] // 2 * m
    inputs = U[:count]
    gamma, X = eye, np.zeros((count, p * m, n))
    gammas, forced = [], []
    for j in range(i - 1, -1, -1):
        if j < i - 1:
            free = root * (Ad - a * eye) / (1 - a) if j == 0 else ratio
            kick = root / (1 - a) * Bd if j == 0 else drive
            signal = inputs[:, 1] if j == 0 else inputs[:, j + 1] + a * inputs[:, j]
            gamma = free @ gamma
            X = X @ free.T + np.einsum("sr,qi->qris", kick, signal).reshape(count, -1, n)
        gammas.append(C @ gamma)
        forced.append(X @ C.T)
    gamma = np.concatenate(gammas[::-1])
    forced = np.stack(forced[::-1]).transpose(0, 3, 1, 2).reshape(len(gamma), -1)
    Q = np.linalg.qr(gamma)[0]
    table = (forced - Q @ (Q.T @ forced)).reshape(-1, p * m)
    right = Yf.T[:, :count]
    right = (right - Q @ (Q.T @ right)).ravel()

    def symmetric(table, right):
        r, c = np.triu_indices(p)
        basis = np.zeros((p, p, len(r)))
        basis[r, c, range(len(r))] = basis[c, r, range(len(r))] = 1.0
        basis = basis.reshape(p * p, -1)
        return (basis @ np.linalg.lstsq(table @ basis, right, rcond=None)[0]).reshape(p, p)

    inverse = symmetric(table @ np.kron(np.eye(p), E.T), right)
    K = symmetric(np.kron(inverse, np.eye(p)), -A21.ravel())
    D = symmetric(np.kron(inverse, np.eye(p)), -A22.ravel())
    return np.linalg.inv(inverse), D, K


def scaled_loop(u, y, taus, shared):
    """The whole loop, matrices in the record's units."""
    su, sy = u.std(axis=0), y.std(axis=0)
    u, y = u / su, (y - y.mean(axis=0)) / sy
    found = np.empty((3, len(taus), len(ROWS), 2, 2))
    for k, tau in enumerate(taus):
        if shared:
            a, U, Y = loop_factor(u, y, tau, max(ROWS))
        for column, i in enumerate(ROWS):
            if not shared:
                a, U, Y = loop_factor(u, y, tau, i)
            found[:, k, column] = loop_choice(a, U, Y, i, np.diag(su * sy))
    # The equation of motion is multiplied by the motions' units, which keeps its matrices symmetric.
    units = np.array([H**2, H, 1.0])[:, None, None] / np.outer(sy, sy)
    return found * units[:, None, None]


def timed(function, repeats):
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time-constants", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    u, y, _ = data.reference_record(0)
    record = jaxgray.Record(u, y, H)
    taus = np.geomspace(0.02, 0.3, arguments.time_constants)
    poles = pole(jax.numpy.asarray(taus), H)
    scaling = scaling_of([record])
    signals = prepare(record, scaling)
    drive = Force(jax.numpy.eye(2)).scaled(scaling.coordinates, scaling.inputs, H)
    setting = Setting(drive, record.measured, record.hold)
    static = {
        "inputs": 2,
        "padded": max(ROWS),
        "weight": MOESP(),
        "map": ExactMap(),
        "measured": setting.measured,
        "hold": setting.hold,
        "householder": False,
    }

    def compress():
        return jax.block_until_ready(
            factors(poles, signals.stacked, signals.inside, inputs=2, block_rows=max(ROWS), householder=False)
        )

    def ours():
        grid, householder = record_factors([signals], poles, max(ROWS))
        assert not householder
        found = candidates(grid, poles, jax.numpy.asarray(ROWS, float), None, **static)
        return physical_grid(found, setting)

    matrices, usable, by_clarabel = ours()
    result = {"cores": os.cpu_count(), "cells": len(taus) * len(ROWS), "by_clarabel": int(by_clarabel.sum())}
    result["factors_s"] = timed(compress, arguments.repeats)
    result["jaxgray_s"] = timed(ours, arguments.repeats)
    start = time.perf_counter()
    loop = scaled_loop(u, y, taus, True)
    result["loop_shared_s"] = time.perf_counter() - start
    few = taus[::8]
    start = time.perf_counter()
    scaled_loop(u, y, few, False)
    result["loop_alone_s"] = (time.perf_counter() - start) * len(taus) / len(few)
    result["jaxgray_again_s"] = timed(ours, arguments.repeats)
    best = min(result["jaxgray_s"], result["jaxgray_again_s"])
    jaxgray.sweep(record, taus, ROWS)
    start = time.perf_counter()
    jaxgray.sweep(record, taus, ROWS)
    result["sweep_with_free_runs_s"] = time.perf_counter() - start
    ours_matrices = np.array([np.asarray(X) for X in scaling.matrices_out(*matrices)])
    # Where the cone is active, the loop has no answer to compare.
    inside = usable & ~by_clarabel
    apart = np.linalg.norm(ours_matrices - loop, axis=(3, 4)) / np.linalg.norm(loop, axis=(3, 4))
    result["worst_difference"] = float(np.max(apart[:, inside]))
    result["compared"] = int(inside.sum())
    result["ratio_shared"] = result["loop_shared_s"] / best
    result["ratio_alone"] = result["loop_alone_s"] / best
    print(f"{result['cells']} choices, {result['cores']} cores, N = {len(u)}")
    print(f"jaxgray, factors of all time constants     {result['factors_s']:8.3f} s")
    print(f"jaxgray, M, D, K of all                     {best:8.3f} s (bar 3)")
    print(f"jaxgray.sweep, every choice simulated too   {result['sweep_with_free_runs_s']:8.3f} s")
    print(f"loop, one factor per τ                      {result['loop_shared_s']:8.3f} s", end="")
    print(f"  ratio {result['ratio_shared']:.1f} (bar 8)")
    print(f"loop, one factor per choice                 {result['loop_alone_s']:8.3f} s", end="")
    print(f"  ratio {result['ratio_alone']:.1f} (bar 20)")
    print(f"M, D, K apart by at most {result['worst_difference']:.1e} (bar 1e-6) over {result['compared']} choices")
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
