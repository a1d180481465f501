"""SIPPY (`sippy_unipi`): N4SID and CVA."""

import importlib.metadata

from physical import physical
from sippy_unipi import system_identification

VERSION = f"sippy_unipi {importlib.metadata.version('sippy_unipi')}"


def subspace(method, u, y, h, horizon):
    model = system_identification(y.T, u.T, method, SS_fixed_order=4, SS_f=horizon, SS_p=horizon, tsample=h)
    return physical(model.A, model.B, model.C, h), f"horizon {horizon}"


def n4sid(u, y, h, horizon=30):
    return subspace("N4SID", u, y, h, horizon)


METHODS = {"sippy": n4sid}
