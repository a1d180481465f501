"""A model as C, for controllers: the sampled matrices and a function that takes one step."""

import re

import numpy as np

from ...mechanics.model import MechanicalModel
from .arrays import arrays_of

TEMPLATE = """\
/* {title}, written by jaxgray.
 *
 * Inputs:  {inputs}
 * Outputs: {outputs}
 *
 * y = C x + D u, then x <- A x + B u, exact at samples {time} s apart where the input {held}.
 * The state is x = (q, dq/dt) - H u, q the coordinates {coordinates}.
 *
 *     {PREFIX}_REAL x[{PREFIX}_STATES];
 *     {prefix}_start(x, 0, 0, u);        at rest, or from displacements and velocities; u: the first input
 *     for (;;) {prefix}_step(x, u, y);   reads the input u of this sample, writes its outputs y
 */
#ifndef {PREFIX}_H
#define {PREFIX}_H

#ifndef {PREFIX}_REAL
#define {PREFIX}_REAL double
#endif

#define {PREFIX}_STATES {states}
#define {PREFIX}_INPUTS {width}
#define {PREFIX}_OUTPUTS {height}
#define {PREFIX}_SAMPLING_TIME {time}

{matrices}
static inline void {prefix}_start({PREFIX}_REAL *x, const {PREFIX}_REAL *q, const {PREFIX}_REAL *v, \
const {PREFIX}_REAL *u)
{{
    int i, j;
    for (i = 0; i < {PREFIX}_STATES; i++) {{
        const {PREFIX}_REAL *part = i < {PREFIX}_STATES / 2 ? q : v;
        x[i] = part ? part[i % ({PREFIX}_STATES / 2)] : 0;
        for (j = 0; j < {PREFIX}_INPUTS; j++) x[i] -= {prefix}_H[i][j] * u[j];
    }}
}}

static inline void {prefix}_step({PREFIX}_REAL *x, const {PREFIX}_REAL *u, {PREFIX}_REAL *y)
{{
    {PREFIX}_REAL next[{PREFIX}_STATES];
    int i, j;
    for (i = 0; i < {PREFIX}_OUTPUTS; i++) {{
        y[i] = 0;
        for (j = 0; j < {PREFIX}_STATES; j++) y[i] += {prefix}_C[i][j] * x[j];
        for (j = 0; j < {PREFIX}_INPUTS; j++) y[i] += {prefix}_D[i][j] * u[j];
    }}
    for (i = 0; i < {PREFIX}_STATES; i++) {{
        next[i] = 0;
        for (j = 0; j < {PREFIX}_STATES; j++) next[i] += {prefix}_A[i][j] * x[j];
        for (j = 0; j < {PREFIX}_INPUTS; j++) next[i] += {prefix}_B[i][j] * u[j];
    }}
    for (i = 0; i < {PREFIX}_STATES; i++) x[i] = next[i];
}}

#endif
"""

HELD = {"zero": "is held between samples", "linear": "is straight between samples"}


def c_header(model: MechanicalModel, name: str, *, sampling_time: float | None, hold: str, linear: bool) -> bytes:
    """A header in C99 (and C++) without dependencies; all its names begin with that of the file.

    **Arguments:** `model`; `name` of the file without ending; `sampling_time` [s]; `hold`; `linear`.

    **Returns:** the content of the file.

    **Raises:** `ValueError` without a sampling time.
    """
    if sampling_time is None:
        raise ValueError("sampling_time is missing, and C runs sample by sample; give it in s (--sampling-time).")
    arrays = arrays_of(model, sampling_time, hold, linear)
    prefix = re.sub(r"\W", "_", name, flags=re.ASCII)
    if not prefix[:1].isalpha():
        prefix = f"model_{prefix}"
    matrices = [_matrix(prefix, key, getattr(arrays, key)) for key in "ABCDH"]
    text = TEMPLATE.format(
        title=_comment(name),
        inputs=_channels(model.input_names, model.input_units),
        outputs=_channels(model.output_names, model.output_units, model.measured),
        coordinates=_comment(", ".join(arrays.states[: len(arrays.states) // 2])),
        prefix=prefix,
        PREFIX=prefix.upper(),
        states=len(arrays.A),
        width=arrays.B.shape[1],
        height=len(arrays.C),
        time=repr(float(sampling_time)),
        held=HELD[hold],
        matrices="\n".join(matrices),
    )
    return text.encode()


def _matrix(prefix: str, key: str, X: np.ndarray) -> str:
    rows = ",\n".join("    {" + ", ".join(map(repr, row)) + "}" for row in X.tolist())
    real = f"{prefix.upper()}_REAL"
    return f"static const {real} {prefix}_{key}[{X.shape[0]}][{X.shape[1]}] = {{\n{rows}\n}};\n"


def _channels(names, units, measured=None) -> str:
    kinds = [""] * len(names) if measured is None else [f" ({kind})" for kind in measured]
    return _comment(", ".join(f"{n}{f' [{u}]' if u else ''}{k}" for n, u, k in zip(names, units, kinds)))


def _comment(text: str) -> str:
    """Nothing that ends a comment, or a line; a backslash first, as the slash in its place could end one."""
    text = " ".join(text.split()).replace("\\", "/")
    return "".join(c if c.isprintable() else "?" for c in text).replace("*/", "* /").replace("/*", "/ *")
