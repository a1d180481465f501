"""Tables for pandas, which is fetched when one is asked for."""


def data_frame(rows: list[dict], columns: tuple[str, ...] = (), *, index: str | None = None):
    """Rows as a pandas `DataFrame`.

    **Arguments:** `rows`: values by the names of their columns; `columns`: those that must be there even without rows;
    `index`: the column that names the rows; default their numbers.

    **Raises:** `ImportError` without pandas, which says how to install it.
    """
    try:
        import pandas
    except ImportError:
        raise ImportError("to_dataframe needs pandas: pip install 'jaxgray[pandas]'.") from None
    frame = pandas.DataFrame(rows, columns=list(dict.fromkeys((*columns, *(name for row in rows for name in row)))))
    return frame if index is None else frame.set_index(index)
