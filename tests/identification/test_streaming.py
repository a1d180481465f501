"""Files in chunks: the same model as from the whole record, and later samples without reading the first again."""

import independent as data
import numpy as np
import pytest

from jaxgray import CompressedRecord, Record, compress, sweep

H = data.REFERENCE_TIME * 4
SAMPLES = 4000
TAU, ROWS = 0.1, 6
NAMES = ("u1", "u2", "y1", "y2")


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(3)
    u = data.random_steps(rng, SAMPLES, 2, H, (0.2, 1.5))
    y = data.simulate(*data.REFERENCE.values(), u, H, x0=[0.01, 0.0, 0.05, 0.0]) + 0.003
    return np.hstack([u, y + data.REFERENCE_NOISE * rng.standard_normal(y.shape)])


@pytest.fixture(scope="module")
def whole(table):
    found = sweep(Record(table[:, :2], table[:, 2:], H), TAU, ROWS)
    return found.mass[0, 0], found.damping[0, 0], found.stiffness[0, 0]


def matrices(model):
    return model.mass, model.damping, model.stiffness


def written(kind, table, folder):
    path = folder / f"record.{kind}"
    if kind == "npy":
        np.save(path, table)
        return path, [f"data[{k}]" for k in range(4)]
    if kind == "parquet":
        pyarrow = pytest.importorskip("pyarrow")
        parquet = pytest.importorskip("pyarrow.parquet")
        parquet.write_table(pyarrow.table(dict(zip(NAMES, table.T))), path)
        return path, NAMES
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["u"], file["test/y1"], file["test/y2"] = table[:, :2], table[:, 2], table[:, 3]
    return path, ["u[0]", "u[1]", "test/y1", "test/y2"]


@pytest.mark.parametrize("kind", ["npy", "parquet", "h5"])
def test_chunks_give_the_model_of_the_whole_record(kind, table, whole, tmp_path):
    path, names = written(kind, table, tmp_path)
    options = {"sampling_time": H, "time_constants": TAU, "block_rows": ROWS, "chunk_samples": 1700}
    found = compress(path, inputs=names[:2], outputs=names[2:], **options)
    assert found.samples == SAMPLES
    assert data.relative_errors(matrices(found.model()), whole).max() < 1e-7
    with pytest.raises(ValueError, match="column 'x' is not in record"):
        compress(path, inputs="x", outputs=names[2:], **options)


def test_later_samples_need_not_the_first(table, whole, tmp_path):
    path, names = written("npy", table[:2500], tmp_path)
    options = {"sampling_time": H, "time_constants": TAU, "block_rows": ROWS}
    compress(path, inputs=names[:2], outputs=names[2:], **options).save(tmp_path / "kept.npz")
    path.unlink()
    kept = CompressedRecord.load(tmp_path / "kept.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "kept.npz").read_bytes()[:-200])
    np.savez(tmp_path / "other.npz", u=np.ones(3))
    for name in ("cut.npz", "other.npz"):
        with pytest.raises(ValueError, match=f"{name} is no "):
            CompressedRecord.load(tmp_path / name)
    longer = kept.extended([table[2500:]])
    assert longer.samples == SAMPLES
    assert data.relative_errors(matrices(longer.model()), whole).max() < 1e-7
    joined = kept.joined([table[2500:]])
    pair = [Record(part[:, :2], part[:, 2:], H) for part in (table[:2500], table[2500:])]
    both = sweep(pair, TAU, ROWS)
    truth = (both.mass[0, 0], both.damping[0, 0], both.stiffness[0, 0])
    assert data.relative_errors(matrices(joined.model()), truth).max() < 1e-7
    with pytest.raises(ValueError, match="missing values"):
        kept.extended([np.full((5, 4), np.nan)])


@pytest.mark.slow
def test_choice_is_made_on_the_first_chunk(table, tmp_path):
    path, names = written("npy", table, tmp_path)
    found = compress(path, inputs=names[:2], outputs=names[2:], sampling_time=H)
    assert data.relative_errors(matrices(found.model()), data.REFERENCE.values()).max() < 0.03
