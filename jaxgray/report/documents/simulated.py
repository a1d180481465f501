"""What a model makes of a record, as a file."""

from ...mechanics.fitted_run import fitted_run
from ...numerics.whole_files import write_whole
from ...records import Record, record_of
from .columns import columns_text, simulation_columns
from .export import model_of


def write_simulation(result_or_model, record: Record, path) -> None:
    """Write measured, simulated and residual of every output over time, as comma-separated text.

    The free run is that of the whole model, its effects included, from the first state and with the output offsets by
    which it comes nearest to the record; the file is whole or not there. `jaxgray simulate --out` writes the same.

    **Arguments:** `result_or_model`: a `MechanicalModel`, or an identification or a diagnosis; `record`, with the
    model's channels in its order; `path`: of the file.

    **Raises:** `ValueError` where there is no model, model and record do not fit, or the folder is not there;
    `ComputationError` where the motion is not finite.

    **Example:**

        >>> import pathlib
        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> jaxgray.write_simulation(model, record, "simulation.csv")
        >>> print(pathlib.Path("simulation.csv").read_text().splitlines()[0])
        time [s],y1 measured,y1 simulated,y1 residual
    """
    run = fitted_run(model_of(result_or_model), record_of(record, "record")).simulated
    write_whole(columns_text(simulation_columns(record, run)).encode(), path)
