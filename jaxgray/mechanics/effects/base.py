"""What every effect is: a physical law with parameters, acting at a place, that a linear model lacks.

A law is a class without data; a `Term` is a law at a place with values for its parameters. Four kinds enter the
simulation at four points:

    inputs ─ AbstractInputEffect ─▶ plant (AbstractMatrixEffect) with forces (AbstractForceEffect) ─▶
    AbstractOutputEffect ─▶ y
"""

import abc
import functools
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Parameter:
    """One parameter of a law.

    `name`: symbol; `unit`: powers of force, length and time it is measured in ("time" is always s); `lower`, `upper`:
    physical bounds; `amplitude`: whether the law is linear in it (or nearly, while the effect is weak); `counts`:
    whether it is estimated (and counts in the information criterion), or fixed by the shape and only reported;
    `choices`: words for the values 0, 1, … of a fixed parameter. Parameters of the same name make a list.
    """

    name: str
    unit: tuple[int, int, int] = (0, 0, 0)
    lower: float = -np.inf
    upper: float = np.inf
    amplitude: bool = False
    counts: bool = True
    choices: tuple[str, ...] = ()


class Local(eqx.Module):
    """What a force law sees at its place: scalars in a simulation, series over time in a feature.

    `q`, `v`: displacement and velocity of the coordinate, or the difference of two; `a`: acceleration that the
    linear model has there; `compliance`: bᵀM⁻¹b, the acceleration a unit force makes there; `u`: the input, for a
    law that acts at an input, otherwise 0; `t` [s] from the start of the record; `p`: scheduling channel, 0 without.

    `turn`: which way dry friction acts, from −1 to 1, where the simulation solves it (`mechanics.runs.dry_friction`),
    None where the velocity says it.
    """

    q: Array
    v: Array
    a: Array
    compliance: Array
    u: Array
    t: Array
    p: Array
    turn: Array | None = None


@dataclass(frozen=True)
class Scales:
    """Sizes in the record by which shapes are chosen, at one place.

    `q`, `v`: root mean square of displacement and velocity about zero; `q_peak`, `v_peak`: largest absolute values;
    `q_quantiles`: 0.5, 0.7, 0.8, 0.9, 0.95, 0.98 quantiles of |q|; `u`, `u_peak`, `u_quantiles`: likewise of the
    input (for input effects); `force`: typical force at the place; `compliance`: bᵀM⁻¹b; `sampling_time` [s];
    `duration` [s]; `frequencies_hz`: natural frequencies of the linear model; `lines_hz`: strongest lines of the
    residual's spectrum; `times`: candidate times [s] of a sudden change.
    """

    q: float
    v: float
    q_peak: float
    v_peak: float
    q_quantiles: tuple[float, ...]
    u: float
    u_peak: float
    u_quantiles: tuple[float, ...]
    force: float
    compliance: float
    sampling_time: float
    duration: float
    frequencies_hz: tuple[float, ...]
    lines_hz: tuple[float, ...] = ()
    times: tuple[float, ...] = ()


class AbstractEffect(eqx.Module):
    """A law. Class attributes say what it is; the instance has no data, so that it can be compared and hashed.

    `id`: as in files and messages; `family`: file it belongs to; `parameters`; `parity`: "odd", "even" or "none" of the
    force in (q, v), or of the signal; `signature`: what gives it away, one line; `law`: formula in words; `reference`;
    `places`: where it can act: "coordinate" (one to ground), "spring" (one to ground, or between two), "pair" (between
    two only), "input", "output", "record" (all outputs), "cross" (source->polluted); `contains`: ids of simpler laws
    that it turns into where its further parameters vanish; `becomes`: ids of those that it is where it is `unresolved`;
    `renamed`: ids of simpler laws that it contains under other names of the parameters; `resembles`: a word that laws
    share which a record hardly tells apart, "" for none; `by_contact`: ids of the names that this law has where it acts
    in more than half of the samples, and in fewer, none for others; `repeats`: whether the force comes again and again
    over displacement; `tied_to_clock`: whether it belongs to the clock of one record, so that another record, or
    another part, may not show it; `own_phase`: whether every record has it with another phase; `onset`: parameters that
    are the time and the width of a sudden change, none for others; `alters`: the matrix that it alters over time, and
    the parameter that says by how much, none for others; `replaces`: "stiffness" or "damping" where this law may stand
    for the whole spring or damper at its place, "" for neither; `jumps`: whether the force jumps where the velocity
    changes sign; `told_apart`: what to change in the experiment, besides the inputs, so that a record tells it from its
    look-alikes, one sentence, "" for nothing; `scheduled`: whether it needs a scheduling channel; `stage`: whether a
    finding says what is missing of the "model" or wrong with the "record".
    """

    id: ClassVar[str]
    family: ClassVar[str]
    law: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    parity: ClassVar[str] = "none"
    signature: ClassVar[str]
    reference: ClassVar[str]
    places: ClassVar[str]
    contains: ClassVar[tuple[str, ...]] = ()
    becomes: ClassVar[tuple[str, ...]] = ()
    renamed: ClassVar[tuple[str, ...]] = ()
    resembles: ClassVar[str] = ""
    by_contact: ClassVar[tuple[str, str] | tuple[()]] = ()
    repeats: ClassVar[bool] = False
    tied_to_clock: ClassVar[bool] = False
    own_phase: ClassVar[bool] = False
    onset: ClassVar[tuple[str, str] | tuple[()]] = ()
    alters: ClassVar[tuple[str, str] | tuple[()]] = ()
    replaces: ClassVar[str] = ""
    jumps: ClassVar[bool] = False
    told_apart: ClassVar[str] = ""
    scheduled: ClassVar[bool] = False
    stage: ClassVar[str] = "model"

    __getattribute__ = object.__getattribute__
    """Methods as they are: equinox makes a tree of each that is asked for, which without data in it is all cost."""

    @abc.abstractmethod
    def shapes(self, scales: Scales) -> list[np.ndarray]:
        """Parameter vectors to try: one per shape, every amplitude 1 and every other parameter set.

        A parameter that is small when the effect is weak (a delay, a gap) is an amplitude too, if the response is
        nearly linear in it: then its entry is a typical size.
        """

    def looks(self, scales: Scales, grid: list[np.ndarray]) -> int:
        """Number of shapes that the penalty of a search counts for `grid` (what `shapes` gave): more than its length
        where the record itself chose them."""
        return len(grid)

    def basis(self, p: np.ndarray) -> list[np.ndarray]:
        """Parameter vectors whose responses, taken linearly, span what a shape can do: one per amplitude, the other
        amplitudes zero."""
        amplitudes = [k for k, parameter in enumerate(self.parameters) if parameter.amplitude]
        vectors = []
        for k in amplitudes:
            one = np.array(p, dtype=float)
            one[[j for j in amplitudes if j != k]] = 0.0
            vectors.append(one)
        return vectors

    def combine(self, p: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """The parameter vector that a sum of the `basis` with these weights stands for, within the bounds."""
        result = np.array(p, dtype=float)
        amplitudes = limits(type(self))[2]
        result[amplitudes] = result[amplitudes] * np.asarray(weights)
        return self.bounded(result)

    def moved(self, p: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Parameters after a change that may be large: p + change, unless the response stays more nearly linear along
        another curve."""
        return p + change

    def widened(self, p: np.ndarray, simple: dict[str, float]) -> np.ndarray:
        """Where a refit begins that goes on from a simpler law, one that this `contains`: what both name has the values
        of `simple`, everything else those of `p`."""
        return self.bounded([simple.get(parameter.name, value) for parameter, value in zip(self.parameters, p)])

    def named_values(self, p: np.ndarray) -> dict[str, float]:
        """Values by name; laws that contain others with other names, or signs, add those."""
        return {parameter.name: float(value) for parameter, value in zip(self.parameters, p)}

    def unresolved(self, p: np.ndarray, scales: Scales) -> str | None:
        """Why the law is another one at these values, as far as a record can show: one clause for the reader, or None
        (default). `p`: parameter vector; `scales`: sizes of the record at the place."""
        return None

    def bounded(self, p: np.ndarray) -> np.ndarray:
        """The parameter vector moved inside its bounds."""
        lower, upper, _ = limits(type(self))
        return np.clip(np.asarray(p, dtype=float), lower, upper)


@functools.cache
def limits(law: type[AbstractEffect]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper bounds of the parameters of a law, and the positions of its amplitudes."""
    sizes = [k for k, parameter in enumerate(law.parameters) if parameter.amplitude]
    return (
        np.array([parameter.lower for parameter in law.parameters], dtype=float),
        np.array([parameter.upper for parameter in law.parameters], dtype=float),
        np.array(sizes, dtype=int),
    )


def onset_of(effect: AbstractEffect) -> tuple[int, int]:
    """Positions of the time and of the width of a sudden change among the parameters of a law that has an `onset`."""
    names = [parameter.name for parameter in effect.parameters]
    return names.index(effect.onset[0]), names.index(effect.onset[1])


class AbstractForceEffect(AbstractEffect):
    """A force on the left side of M q̈ + D q̇ + K q + b f = E u, with states of its own where it has memory.

    `states`: how many; `element`: "stiffness" or "damping" of a law without parameters whose force is its input times
    the displacement or the velocity, "" for others.
    """

    states: ClassVar[int] = 0
    element: ClassVar[str] = ""

    @abc.abstractmethod
    def force(self, p: Float[Array, " parameters"], here: Local, z: Float[Array, " states"]) -> Array:
        """f at one instant; written so that it takes series over time as well (z then has time last)."""

    def rubbing(self, p: Float[Array, " parameters"], here: Local) -> tuple[Array, Array]:
        """Size of the dry friction in f, and the velocity over which it turns with the motion; 0 and 0 for none."""
        return 0.0 * here.v, 0.0 * here.v

    def advance(
        self, p: Float[Array, " parameters"], z: Float[Array, " states"], before: Local, after: Local, time: Array
    ) -> Float[Array, " states"]:
        """z after a step of `time` [s] from `before` to `after`, exact for uniform motion (sign frozen)."""
        return z


class AbstractInputEffect(AbstractEffect):
    """A change of one input on its way to the plant.

    The input over sample k runs from start[k] to end[k] in a straight line (equal under a zero-order hold). `rank`:
    effects of a lower one come first; those of one rank in the order in which they are in the model. At the samples a
    higher one comes first, but for 0: what is neither of rank 0 nor of rank 1 has to commute with every other.
    """

    rank: ClassVar[int] = 1

    @abc.abstractmethod
    def apply(
        self,
        p: Float[Array, " parameters"],
        start: Float[Array, " samples"],
        end: Float[Array, " samples"],
        time: Array,
    ) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
        """The changed input, given the sampling `time` [s]. Traced, differentiable by p."""

    def at_samples(
        self,
        p: Float[Array, " parameters"],
        start: Float[Array, " samples"],
        end: Float[Array, " samples"],
        seen: Float[Array, " samples"],
        time: Array,
    ) -> Float[Array, " samples"]:
        """The changed input at the samples themselves, where an accelerometer sees it; `seen`: the input there. What
        `apply` gives are straight lines over the samples, whose ends may be off it."""
        return self.apply(p, seen, seen, time)[0]


class AbstractOutputEffect(AbstractEffect):
    """A change of one output after the plant."""

    @abc.abstractmethod
    def apply(
        self, p: Float[Array, " parameters"], y: Float[Array, " samples"], source: Float[Array, " samples"], time: Array
    ) -> Float[Array, " samples"]:
        """The changed output, given the `source` channel (of a crosstalk, else zeros) and the sampling `time` [s]."""


class AbstractMatrixEffect(AbstractEffect):
    """A change of M, D, K themselves, perhaps with one more coordinate: still a linear model.

    `extra`: whether it adds a coordinate (the last row and column of the matrices it returns).
    """

    extra: ClassVar[bool] = False

    @abc.abstractmethod
    def matrices(
        self,
        p: Float[Array, " parameters"],
        M: Float[Array, "dofs dofs"],
        D: Float[Array, "dofs dofs"],
        K: Float[Array, "dofs dofs"],
        first: Float[Array, " dofs"],
        second: Float[Array, " dofs"],
    ) -> tuple[Array, Array, Array]:
        """The changed matrices; `first` is the arm b of the place (of the first coordinate of a pair), `second` the
        unit vector of the second coordinate of a pair (else zeros)."""


class Place(eqx.Module):
    """Where an effect acts.

    `name`: as in files; `first`, `second`: indices of coordinate, input or output; `second` is −1 where there is
    none, and of a crosstalk the source, counted over the outputs first and then the inputs.
    """

    name: str = eqx.field(static=True)
    first: int = eqx.field(static=True)
    second: int = eqx.field(static=True, default=-1)


class Term(eqx.Module):
    """A law at a place with values, as a model carries it."""

    effect: AbstractEffect
    place: Place
    values: Float[Array, " parameters"]

    def parameter(self, name: str) -> float:
        """The value of a parameter by its symbol."""
        names = [p.name for p in self.effect.parameters]
        return float(self.values[names.index(name)])


def places_of(effect: AbstractEffect, input_names, output_names, hidden=()) -> tuple[Place, ...]:
    """Every place where an effect can act in a system with these channels and hidden coordinates, as files and messages
    name them."""
    return _places(effect.places, tuple(input_names), tuple(output_names), tuple(hidden))


@functools.lru_cache(maxsize=64)
def _places(
    kind: str, input_names: tuple[str, ...], output_names: tuple[str, ...], hidden: tuple[str, ...]
) -> tuple[Place, ...]:
    names = output_names + hidden
    pairs = [Place(f"{a}-{b}", i, j) for i, a in enumerate(names) for j, b in enumerate(names) if i < j]
    single = [Place(name, k) for k, name in enumerate(names)]
    if kind == "coordinate":
        return tuple(single)
    if kind == "spring":
        return tuple(single + pairs)
    if kind == "pair":
        return tuple(pairs)
    if kind == "input":
        return tuple(Place(name, k) for k, name in enumerate(input_names))
    if kind == "output":
        return tuple(single[: len(output_names)])
    if kind == "record":
        return (Place("record", -1),)
    sources = [*output_names, *input_names]
    return tuple(
        Place(f"{source}->{name}", k, s)
        for k, name in enumerate(output_names)
        for s, source in enumerate(sources)
        if s != k
    )
