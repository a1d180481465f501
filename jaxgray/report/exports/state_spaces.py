"""A model as state space of SciPy and of python-control."""

from ...mechanics.systems.statespace import check_hold
from ...records.channels import as_seconds
from .arrays import arrays_of


def to_scipy(model, *, sampling_time: float | None = None, hold: str = "zero", linear: bool = False):
    """A model as `scipy.signal.StateSpace`.

    The state is (q, q̇), under a linear hold (q, q̇) less what the hold takes out of the recursion; of a measured base
    displacement x the velocities are q̇ − M⁻¹ D r x.

    **Arguments:**

    - `model`: a `MechanicalModel`.
    - `sampling_time`: in s, of a sampled system; default none, for continuous time.
    - `hold`: the input between samples of a sampled system, `"zero"` (default) or `"linear"`.
    - `linear`: leave out effects that are not linear; default False, which refuses them.

    **Raises:** `ValueError` where an argument does not fit, or the model has effects that are not linear.

    **Example:**

        >>> import jaxgray
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> jaxgray.to_scipy(model).A
        array([[  0. ,   1. ],
               [-40. ,  -1.5]])
    """
    import scipy.signal

    arrays, step = _checked(model, sampling_time, hold, linear)
    options = {} if step is None else {"dt": step}
    return scipy.signal.StateSpace(arrays.A, arrays.B, arrays.C, arrays.D, **options)


def to_control(model, *, sampling_time: float | None = None, hold: str = "zero", linear: bool = False):
    """A model as `control.StateSpace` of python-control, its signals named.

    **Arguments:** as for `to_scipy`: `model`, `sampling_time`, `hold`, `linear`.

    **Raises:** as `to_scipy`, and `ImportError` without python-control.

    **Example:**

        >>> import jaxgray
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> jaxgray.to_control(model).poles().round(3)
        array([-0.75+6.28j, -0.75-6.28j])
    """
    try:
        import control
    except ImportError:
        raise ImportError("to_control needs python-control: pip install 'jaxgray[control]'.") from None

    arrays, step = _checked(model, sampling_time, hold, linear)
    # python-control writes transfer functions as `y[u]` and keeps dots for itself.
    names = {
        "inputs": [_name(one) for one in model.input_names],
        "outputs": [_name(one) for one in model.output_names],
        "states": [_name(one) for one in arrays.states],
    }
    return control.ss(arrays.A, arrays.B, arrays.C, arrays.D, 0 if step is None else step, **names)


def _checked(model, sampling_time, hold, linear):
    check_hold(hold)
    step = None if sampling_time is None else as_seconds("sampling_time", sampling_time)
    return arrays_of(model, step, hold, linear), step


def _name(text: str) -> str:
    return text.replace(".", "_")
