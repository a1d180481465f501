"""Writing small files for the readers."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def text():
    """The text of a table, from a header and columns."""

    def render(header, *data, delimiter=",", form=repr):
        rows = zip(*(np.asarray(column).tolist() for column in data))
        return "\n".join([header, *(delimiter.join(form(value) for value in row) for row in rows)]) + "\n"

    return render


@pytest.fixture
def write(tmp_path):
    """A file with the given content, and its path."""

    def put(content, name="record.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
        return path

    return put
