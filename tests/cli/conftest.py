"""A place for compiled code that is not the user's, and the records that the commands read."""

import numpy as np
import pytest
from independent import REFERENCE, REFERENCE_TIME, random_steps, reference_record, simulate

SAMPLES = 2000


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Compiled code goes to a folder of the session."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def table(u, y, header="time [s],u1 [N],u2 [N],y1 [m],y2 [m]"):
    """The text of a csv file."""
    t = REFERENCE_TIME * np.arange(len(u))
    rows = [",".join(map(repr, row)) for row in np.column_stack([t, u, y]).tolist()]
    return "\n".join([header, *rows]) + "\n"


@pytest.fixture(scope="session")
def records(tmp_path_factory):
    """An estimation and a validation record of the reference system, as files."""
    folder = tmp_path_factory.mktemp("records")
    paths = []
    for name, seed in (("estimation", 11), ("validation", 12)):
        u, y, _ = reference_record(seed, samples=SAMPLES)
        paths.append(folder / f"{name}.csv")
        paths[-1].write_text(table(u, y))
    return paths


@pytest.fixture
def small(tmp_path):
    """A short table to spoil: header and rows of cells, and the way to write them."""
    u = random_steps(np.random.default_rng(3), 400, 2, REFERENCE_TIME, hold_times=(0.05, 0.2))
    y = simulate(*REFERENCE.values(), u, REFERENCE_TIME)
    lines = table(u, y).splitlines()
    header, rows = lines[0], [line.split(",") for line in lines[1:]]

    def write(rows=rows, header=header):
        path = tmp_path / "small.csv"
        path.write_text("\n".join([header, *(",".join(row) for row in rows)]) + "\n")
        return path

    return rows, write
