"""The programs of the refits, compiled in a second thread while the linear model is identified and the first look goes
on.

They take longest to compile, and what they are compiled for is known from the start: the record's shape, and the laws
that remember as much as any that is looked for.
"""

import contextlib
import threading

import jax
import numpy as np

from ...identification.refinement.normal_equations import join
from ...identification.setup.options import drive_by
from ...identification.setup.preparation import scaling_of
from ...identification.setup.structure import Structure, structure_of
from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, Term, places_of
from ...mechanics.model import MechanicalModel
from ...numerics.programs.backend import cores
from ...numerics.programs.stored_programs import keeps_programs
from ...records import Record
from .candidate import Candidate, Data, Setup
from .own_laws import laws_of
from .simulator import Simulator, law_table

USUAL = 2
"""Tables of laws that nearly every diagnosis that finds something comes to; the one of those that remember most it may
not."""


@contextlib.contextmanager
def compiling_ahead(
    records: list[Record],
    laws: tuple[AbstractForceEffect, ...],
    searched: tuple[AbstractEffect, ...],
    model: MechanicalModel | None,
    options: dict,
):
    """Prepare what refits of force effects run, meanwhile; nothing where programs are not kept, or on one core.

    **Arguments:** `records`; `laws`: force laws of the catalogue; `searched`: effects that are looked for; `model`: the
    user's own, or None; `options`: of `identify`.
    """
    ended = threading.Event()
    if cores() > 1 and keeps_programs():
        work = (records, laws, searched, model, options, ended)
        threading.Thread(target=_prepare, args=work, name="jaxgray-ahead").start()
    try:
        yield
    finally:
        ended.set()


def _prepare(records, laws, searched, model, options, ended: threading.Event) -> None:
    # Whatever fails here, fails again where it is asked for, and is said there.
    with contextlib.suppress(Exception), jax.enable_x64(True):
        simulator, start = expected(records, laws, model, options)
        data = Data.of(records[0])
        wanted = [start.with_terms((term,)) for term in one_of_each_table(searched, laws, records[0])[:USUAL]]
        works = [(simulator.run_and_jacobian, candidate) for candidate in wanted]
        for run, candidate in works + [(simulator.run, candidate) for candidate in wanted[:1]]:
            # The thread ends with the main one, between programs.
            if ended.is_set() or not threading.main_thread().is_alive():
                return
            run(candidate, data)


def expected(
    records: list[Record], laws: tuple[AbstractForceEffect, ...], model: MechanicalModel | None, options: dict
) -> tuple[Simulator, Candidate]:
    """The simulator of a diagnosis, and a candidate of the shape of its linear model.

    **Arguments:** as for `compiling_ahead`.

    **Raises:** `ValueError`, `ComputationError` for options or records that cannot serve, as `identify` does.
    """
    record = records[0]
    if model is None:
        drive, structure, own = drive_by(record, options), structure_of(options.get("structure")), ()
    else:
        drive, structure, own = model.drive, Structure(), laws_of(model, record)[0]
    names, scaling = (record.input_names, record.output_names), scaling_of(records)
    structure = structure.scaled(np.asarray(scaling.coordinates))
    setup = Setup(drive, record.measured, scaling, structure, np.zeros(0, bool), *names, own=own)
    blocks = structure.blocks(*(np.eye(setup.dofs),) * 3, lift=0.0)
    return Simulator(setup, laws), Candidate(np.asarray(join(blocks)), (np.zeros(2 * setup.dofs),) * len(records))


def one_of_each_table(
    searched: tuple[AbstractEffect, ...], laws: tuple[AbstractForceEffect, ...], record: Record
) -> list[Term]:
    """A force that does nothing for each table of laws, those that remember least first."""
    found = {}
    for effect in sorted((e for e in searched if e in laws), key=lambda effect: effect.states):
        places = places_of(effect, record.input_names, record.output_names)
        if places:
            term = Term(effect, places[0], effect.bounded(np.zeros(len(effect.parameters))))
            found.setdefault(law_table((term,), laws), term)
    return list(found.values())
