"""SLICOT through `ctrlsys`: MOESP for A and C, then B and the first state by IB01CD."""

import importlib.metadata

import ctrlsys
import numpy as np
from physical import physical

VERSION = f"ctrlsys {importlib.metadata.version('ctrlsys')}"
ORDER = 4


def moesp(u, y, h, *, block_rows=100, algorithm="C"):
    """`algorithm`: "C" Cholesky of the correlations, "F" fast QR, "Q" QR; as SLICOT's ALG."""
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    samples, inputs = u.shape
    outputs = y.shape[1]
    _, R, _, warning, info = ctrlsys.ib01ad(
        "M", algorithm, "N", "O", "N", "N", block_rows, inputs, outputs, u, y, 0.0, -1.0
    )
    check("IB01AD", info)
    A, C, *_, info = ctrlsys.ib01bd("M", "C", "N", block_rows, ORDER, inputs, outputs, samples, R, 0.0)
    check("IB01BD", info)
    none = np.zeros((ORDER, inputs), order="F"), np.zeros((outputs, inputs), order="F")
    _, B, _, _, _, _, info = ctrlsys.ib01cd(
        "X", "C", "B", ORDER, inputs, outputs, np.asfortranarray(A), none[0], np.asfortranarray(C), none[1], u, y, 0.0
    )
    check("IB01CD", info)
    return physical(A, B, C, h), ""


def check(routine, info):
    if info != 0:
        raise RuntimeError(f"{routine} returned INFO = {info}")


def moesp_fast_qr(u, y, h):
    return moesp(u, y, h, algorithm="F")


METHODS = {"slicot": moesp, "slicot-fast-qr": moesp_fast_qr}
