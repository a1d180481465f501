"""One record in chunks: the factors of a single pass, and a refined model within its errors."""

import fleet_records as made
import numpy as np
import pytest
from independent import REFERENCE, random_steps, simulate

from jaxgray import MechanicalModel
from jaxgray.fleets import compress_on_workers, refine_on_workers
from jaxgray.fleets.long.source import Source
from jaxgray.records.readers.chunks import count_rows, read_rows

SAMPLES = 9000
NAMES = [f"data[{k}]" for k in range(4)]
OPTIONS = {
    "inputs": NAMES[:2],
    "outputs": NAMES[2:],
    "sampling_time": made.H,
    "time_constants": [0.1, 0.2],
    "block_rows": 4,
}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A record that starts in motion, with an offset."""
    rng = np.random.default_rng(4)
    u = random_steps(rng, SAMPLES, 2, made.H, (0.2, 1.5))
    y = simulate(*REFERENCE.values(), u, made.H, x0=[0.01, 0.0, 0.05, 0.0]) + 0.003
    path = tmp_path_factory.mktemp("long") / "record.npy"
    np.save(path, np.hstack([u, y + made.NOISE * rng.standard_normal(y.shape)]))
    return path


def one_form(factor):
    """Factors with positive diagonals, columns of length one."""
    signs = np.sign(np.diagonal(factor, axis1=1, axis2=2))
    return factor * signs[:, :, None] / np.linalg.norm(factor, axis=1)[:, None, :]


def test_factors_of_chunks_join_to_that_of_one_pass(file, executor):
    whole = compress_on_workers(file, client=executor, chunk_samples=SAMPLES, householder=True, **OPTIONS)
    for householder in (True, False):
        parts = compress_on_workers(file, client=executor, chunk_samples=1501, householder=householder, **OPTIONS)
        assert np.max(np.abs(one_form(parts.factor) - one_form(whole.factor))) < 1e-10
        assert np.allclose(parts.sizes, whole.sizes, rtol=1e-12)
    # Without the states at the seams it would be another factor.
    lone = compress_on_workers(file, client=executor, chunk_samples=1501, samples=1501, **OPTIONS)
    assert np.max(np.abs(one_form(lone.factor) - one_form(whole.factor))) > 1e-4


def test_the_refined_model_is_within_its_errors(file, executor):
    record = compress_on_workers(file, client=executor, chunk_samples=4096, **OPTIONS)
    start = MechanicalModel(*(X * (1 + 0.05 * k) for k, X in enumerate(REFERENCE.values(), start=-1)))
    found = refine_on_workers(record, start, client=executor, segment_samples=2048)
    for name, true in zip(("mass", "damping", "stiffness"), REFERENCE.values()):
        error = np.asarray(getattr(found.model, name)) - true
        assert np.all(np.abs(error) < 4.5 * found.standard_errors[name])
        assert np.all(found.standard_errors[name] < 0.02 * np.max(np.abs(true)))
    assert np.allclose(found.noise, made.NOISE, rtol=0.05)


def test_rows_of_files(tmp_path):
    import h5py
    import pyarrow
    import pyarrow.parquet

    table = np.arange(60.0).reshape(20, 3)
    np.save(tmp_path / "a.npy", table)
    columns = pyarrow.table({f"c{k}": table[:, k] for k in range(3)})
    pyarrow.parquet.write_table(columns, tmp_path / "a.parquet", row_group_size=7)
    with h5py.File(tmp_path / "a.h5", "w") as f:
        f["x"] = table
    for name, wanted in (("a.npy", "data[{}]"), ("a.parquet", "c{}"), ("a.h5", "x[{}]")):
        names = [wanted.format(k) for k in (2, 0)]
        assert count_rows(tmp_path / name, names) == 20
        for first, count in ((0, 20), (6, 9), (13, 1), (18, 9)):
            rows = read_rows(tmp_path / name, names, first, count)
            assert np.array_equal(rows, table[first : first + count][:, [2, 0]])


def test_sources_that_cannot_serve(tmp_path):
    with pytest.raises(ValueError, match="samples=None; say how many a function makes"):
        Source.of(lambda first, count: np.zeros((count, 2)), ("u",), ("y",), None)
    with pytest.raises(ValueError, match="samples 0 to 5 have shape"):
        Source.of(lambda first, count: np.full((count, 2), np.nan), ("u",), ("y",), 5).read(0, 5)
    with pytest.raises(ValueError, match="cannot be read in chunks"):
        (tmp_path / "a.csv").write_text("u,y\n")
        Source.of(tmp_path / "a.csv", ("u",), ("y",), None)
