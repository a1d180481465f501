"""What the diagnosis works on: records as padded arrays, and a model with all that may move in it."""

import dataclasses
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from ...identification.refinement.normal_equations import join, part
from ...identification.setup.padding import padded_samples
from ...identification.setup.structure import Structure
from ...identification.setup.units import Scaling
from ...mechanics.effects.base import Term
from ...mechanics.systems.drives import AbstractDrive, Force
from ...records import Record

LONGER = 4
"""How many times longer a record may become so that its length is that of another."""


@dataclass(frozen=True)
class Data:
    """One record, padded with its last input to one of a few lengths so that little is compiled.

    `u`, `y` (zero where missing), `kept`: whether an output sample counts; `scheduling`; `samples` that are real.
    """

    u: Float[np.ndarray, "samples inputs"]
    y: Float[np.ndarray, "samples outputs"]
    kept: Bool[np.ndarray, "samples outputs"]
    scheduling: Float[np.ndarray, " samples"]
    samples: int
    sampling_time: float
    hold: str

    @classmethod
    def of(cls, record: Record, like: int = 0) -> "Data":
        """A record as the diagnosis takes it, as long as one that is padded already to `like` samples where that is not
        much longer."""
        length = padded_samples(record.samples)
        extra = (like if length < like <= LONGER * length else length) - record.samples
        known = np.isfinite(record.y)
        p = np.zeros(record.samples) if record.scheduling is None else record.scheduling
        return cls(
            np.pad(record.u, ((0, extra), (0, 0)), mode="edge"),
            np.pad(np.where(known, record.y, 0.0), ((0, extra), (0, 0))),
            np.pad(known, ((0, extra), (0, 0))),
            np.pad(p, (0, extra), mode="edge"),
            record.samples,
            record.sampling_time,
            record.hold,
        )

    def part(self, begin: int, size: int, *, padded: bool = False) -> "Data":
        """A part of the record, the record itself where that is shorter. `padded`: with its last input, to one of a few
        lengths."""
        if self.samples <= size:
            return self
        rows, more = slice(begin, begin + size), padded_samples(size) - size if padded else 0

        def cut(X, mode):
            return np.pad(X[rows], ((0, more), *((0, 0),) * (X.ndim - 1)), mode=mode) if more else X[rows]

        driven = {name: cut(getattr(self, name), "edge") for name in ("u", "scheduling")}
        shown = {name: cut(getattr(self, name), "constant") for name in ("y", "kept")}
        return dataclasses.replace(self, **driven, **shown, samples=size)

    @property
    def traced_sampling_time(self) -> Float[np.ndarray, ""]:
        """Sampling time as an array, for compiled functions: a plain number would be compiled in."""
        return np.asarray(self.sampling_time)

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Time of every sample from the first, in s."""
        return self.sampling_time * np.arange(len(self.u))


class Matrices(eqx.Module):
    """M, D, K in the record's units from the joined blocks; a pytree, so that other scalings do not compile again."""

    scaling: Scaling
    structure: Structure

    def __call__(self, entries: Float[Array, " entries"]) -> tuple[Array, Array, Array]:
        dofs = self.scaling.coordinates.shape[0]
        blocks = part(entries, self.structure.sizes(dofs))
        return self.scaling.matrices_out(*self.structure.matrices(blocks, dofs))


@dataclass(frozen=True)
class Setup:
    """What stays as it is while candidates are tried.

    `drive` and `measured` in the record's units; `scaling` and `structure` of the linear parameters; `held`: entries of
    the joined blocks that do not move; `input_names`, `output_names`; `own`: laws of the user's own model, which act
    in every candidate; `hidden`: names of the coordinates that no output measures; `physical`: whether these are places
    of a mechanism, and not of the canonical form.
    """

    drive: AbstractDrive
    measured: tuple[str, ...]
    scaling: Scaling
    structure: Structure
    held: Bool[np.ndarray, " entries"]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    own: tuple[Term, ...] = ()
    hidden: tuple[str, ...] = ()
    physical: bool = True

    @property
    def unmeasured(self) -> tuple[str, ...]:
        """Hidden coordinates that laws can act at."""
        return self.hidden if self.physical else ()

    @property
    def outputs(self) -> int:
        """Outputs; output k measures coordinate k."""
        return len(self.measured)

    @property
    def dofs(self) -> int:
        """Coordinates of the linear model, measured and hidden."""
        return len(self.measured) + len(self.hidden)

    @property
    def per_mass(self) -> bool:
        """Whether forces are those on a mass of one: a moving base leaves the scale of masses open."""
        return not isinstance(self.drive, Force)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Rows of the semidefinite blocks that make M, D, K."""
        return self.structure.sizes(self.dofs)

    @property
    def matrices(self) -> Matrices:
        """M, D, K in the record's units from the joined blocks."""
        return Matrices(self.scaling, self.structure)

    def entries_of(self, mass, damping, stiffness) -> Float[np.ndarray, " entries"]:
        """Joined blocks of M, D, K in the record's units."""
        scaled = self.scaling.matrices_in(*map(np.asarray, (mass, damping, stiffness)))
        return np.asarray(join(self.structure.blocks(*scaled, lift=0.0)))


@dataclass(frozen=True)
class Candidate:
    """A model extended by terms, with the first state of every record.

    `entries`: joined blocks of M, D, K, scaled; `x0`: (q, q̇) per record, in the record's units; `terms`.
    """

    entries: Float[np.ndarray, " entries"]
    x0: tuple[Float[np.ndarray, " states"], ...]
    terms: tuple[Term, ...] = ()

    def with_terms(self, terms) -> "Candidate":
        """The same with other terms."""
        return dataclasses.replace(self, terms=tuple(terms))

    def with_entries(self, entries) -> "Candidate":
        """The same with other M, D, K: joined blocks, scaled, as `Setup.entries_of` makes them."""
        return dataclasses.replace(self, entries=np.asarray(entries, float))


def of_record(candidate: Candidate, record: int) -> list[bool]:
    """Which terms of a candidate act in a record of the fit, by its position: what has another phase in every record is
    in the first one alone."""
    return [record == 0 or not term.effect.own_phase for term in candidate.terms]


def estimated(term: Term) -> list[int]:
    """Positions of the parameters of a term that a fit moves."""
    return [k for k, parameter in enumerate(term.effect.parameters) if parameter.counts]
