"""nfoursid: PO-MOESP, then the states as N4SID has them."""

import importlib.metadata

import pandas as pd
from nfoursid.nfoursid import NFourSID
from physical import physical

VERSION = f"nfoursid {importlib.metadata.version('nfoursid')}"


def subspace(u, y, h, block_rows=30):
    frame = pd.DataFrame({"u1": u[:, 0], "u2": u[:, 1], "y1": y[:, 0], "y2": y[:, 1]})
    found = NFourSID(frame, output_columns=["y1", "y2"], input_columns=["u1", "u2"], num_block_rows=block_rows)
    found.subspace_identification()
    model, _ = found.system_identification(rank=4)
    return physical(model.a, model.b, model.c, h), f"{block_rows} block rows"


METHODS = {"nfoursid": subspace}
