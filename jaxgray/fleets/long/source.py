"""Where the samples of a long record come from: a file that all workers reach, or a function that makes them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...records.readers.chunks import count_rows, read_rows


@dataclass(frozen=True)
class Source:
    """Samples of a record, any stretch of them on any worker.

    `place`: path of a NPY, Parquet or HDF5 file, or a function of first sample and count that can be pickled;
    `columns`: inputs, then outputs; `inputs`: how many of them are inputs; `samples` in all.
    """

    place: str | Callable[[int, int], np.ndarray]
    columns: tuple[str, ...]
    inputs: int
    samples: int

    @classmethod
    def of(cls, place, inputs: tuple[str, ...], outputs: tuple[str, ...], samples: int | None) -> "Source":
        """A source; of a function the number of samples must be given.

        **Raises:** `ValueError` for a file that cannot be read in chunks, or an unknown number of samples.
        """
        columns = (*inputs, *outputs)
        if callable(place):
            if samples is None or samples < 2:
                raise ValueError(f"samples={samples}; say how many a function makes.")
            return cls(place, columns, len(inputs), int(samples))
        rows = count_rows(place, columns)
        if samples is not None and not 2 <= samples <= rows:
            raise ValueError(f"samples={samples}; {place} has {rows}, give 2 to as many, or leave it out.")
        return cls(str(place), columns, len(inputs), rows if samples is None else int(samples))

    def read(self, first: int, count: int) -> Float[np.ndarray, "samples columns"]:
        """Samples from `first` on, at most `count`.

        **Raises:** `ValueError` for missing values, or another shape than the columns'.
        """
        count = min(count, self.samples - first)
        if callable(self.place):
            found = np.asarray(self.place(first, count), dtype=float)
        else:
            found = read_rows(self.place, self.columns, first, count)
        if found.shape != (count, len(self.columns)) or not np.all(np.isfinite(found)):
            raise ValueError(
                f"samples {first} to {first + count} have shape {found.shape} or missing values; give "
                f"{len(self.columns)} finite columns. Records with gaps are read whole, by read_record."
            )
        return found
