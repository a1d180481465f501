"""The models of many records, and how each came out."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from ...mechanics.model import MechanicalModel
from ...mechanics.systems.drives import AbstractDrive
from ...numerics.data_frames import data_frame
from ...numerics.matrices.linear_algebra import triangle
from ...numerics.outcomes import RESULTS


@dataclass(frozen=True, eq=False, repr=False)
class Identifications:
    """Mass, damping and stiffness of every record by itself, in the records' units.

    `mass`, `damping`, `stiffness`: one matrix per record; `covariance` of the stacked upper triangles (by columns) of
    the three, for a white residual; `fit_percent`, `rmse` per output on the record itself; `white`: whether the
    residual is; `results`: the outcome per record, `details` in words; `alone`: which were identified one by one;
    `steps` of the batch's refinement; `time_constant` [s], `block_rows` of the start. Values of failed records are NaN,
    or the record is marked in `results`: check `successful` first.
    """

    mass: Float[np.ndarray, "records dofs dofs"]
    damping: Float[np.ndarray, "records dofs dofs"]
    stiffness: Float[np.ndarray, "records dofs dofs"]
    covariance: Float[np.ndarray, "records entries entries"]
    fit_percent: Float[np.ndarray, "records outputs"]
    rmse: Float[np.ndarray, "records outputs"]
    white: Bool[np.ndarray, " records"]
    results: tuple[RESULTS, ...]
    details: tuple[str, ...]
    alone: Bool[np.ndarray, " records"]
    steps: Int[np.ndarray, " records"]
    time_constant: Float[np.ndarray, " records"]
    block_rows: Float[np.ndarray, " records"]
    drive: AbstractDrive = field(repr=False)
    measured: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.results)

    @property
    def successful(self) -> Bool[np.ndarray, " records"]:
        """Which records have a model that may be used."""
        return np.array([result == RESULTS.successful for result in self.results])

    @property
    def standard_errors(self) -> dict[str, Float[np.ndarray, "records dofs dofs"]]:
        """Standard error of every entry of mass, damping, stiffness; where `white` is false they are too small."""
        dofs = self.mass.shape[1]
        r, c = triangle(dofs)
        parts = np.split(np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0)), 3, axis=1)
        result = {}
        for name, values in zip(("mass", "damping", "stiffness"), parts):
            result[name] = np.zeros((len(self), dofs, dofs))
            result[name][:, r, c] = result[name][:, c, r] = values
        return result

    def model(self, k: int) -> MechanicalModel:
        """The model of record `k`.

        **Raises:** `ValueError` where that record has none.
        """
        if not self.successful[k]:
            raise ValueError(f"record {k} has no model: {self.details[k] or RESULTS[self.results[k]]}")
        return MechanicalModel(
            self.mass[k],
            self.damping[k],
            self.stiffness[k],
            drive=self.drive,
            measured=self.measured,
            input_names=self.input_names,
            output_names=self.output_names,
            input_units=self.input_units,
            output_units=self.output_units,
        )

    def to_dataframe(self):
        """All records as a pandas `DataFrame`, one row a record.

        **Returns:** `successful`; `details` in words; `white`; `alone`; `time_constant` [s], `block_rows`;
        `fit_percent_y1`, …, `rmse_y1`, …; `mass[0,0]`, `mass[0,0]_error`, …: value and standard error of every entry,
        NaN where a record has no model.

        **Raises:** `ImportError` without pandas.
        """
        errors, good = self.standard_errors, self.successful
        rows = []
        for k in range(len(self)):
            row = {
                "successful": bool(good[k]),
                "details": self.details[k] or ("" if good[k] else RESULTS[self.results[k]]),
                "white": bool(self.white[k]),
                "alone": bool(self.alone[k]),
                "time_constant": float(self.time_constant[k]),
                "block_rows": float(self.block_rows[k]),
            }
            for word in ("fit_percent", "rmse"):
                row |= {f"{word}_{name}": float(x) for name, x in zip(self.output_names, getattr(self, word)[k])}
            for name in ("mass", "damping", "stiffness"):
                for r, c in zip(*triangle(self.mass.shape[1])):
                    value, error = float(getattr(self, name)[k, r, c]), float(errors[name][k, r, c])
                    row |= {f"{name}[{r},{c}]": value, f"{name}[{r},{c}]_error": error}
            rows.append(row)
        return data_frame(rows)

    def __repr__(self) -> str:
        good = self.successful
        lines = [
            f"Identifications: {int(good.sum())} of {len(self)} records, {self.mass.shape[1]} coordinates; "
            f"{int(self.alone.sum())} identified one by one"
        ]
        if good.any():
            for name in ("mass", "damping", "stiffness"):
                values, errors = getattr(self, name)[good], self.standard_errors[name][good]
                for row in range(values.shape[1]):
                    entries = "  ".join(
                        f"{np.median(values[:, row, c]):.5g} ± {np.median(errors[:, row, c]):.1g}"
                        f" (spread {np.std(values[:, row, c]):.1g})"
                        for c in range(values.shape[2])
                    )
                    lines.append(f"  {name if row == 0 else '':10s}{entries}")
            fits = ", ".join(f"{n} {v:.2f} %" for n, v in zip(self.output_names, np.median(self.fit_percent[good], 0)))
            lines.append(f"  median fit: {fits}; residual white in {int(self.white[good].sum())}")
        lines += [f"  record {k}: {self.details[k] or RESULTS[self.results[k]]}" for k in np.flatnonzero(~good)[:10]]
        return "\n".join(lines)
