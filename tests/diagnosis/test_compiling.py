"""What is compiled while the linear model is identified is what the refits then run."""

import threading

import hidden
import jax
import numpy as np
import pytest

import jaxgray
from jaxgray.diagnosis import diagnose
from jaxgray.diagnosis.model import compile_ahead as compiling
from jaxgray.diagnosis.model import simulator as response
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.mechanics.effects import CATALOGUE
from jaxgray.numerics.programs import stored_programs
from jaxgray.numerics.programs.backend import flags_are_known

PROGRAMS = response._run_and_derivative, response._run


@pytest.fixture
def case():
    case = hidden.random_case(np.random.default_rng(5), "coulomb_friction", dofs=(1,), samples=600, excess=(2, 4))
    return jaxgray.Record(case.u, case.y, case.sampling_time, hold=case.hold)


@pytest.fixture
def kept(tmp_path, monkeypatch):
    if not flags_are_known():
        pytest.skip("programs are stored with the releases of jaxlib alone that this was tried with")
    monkeypatch.setattr(stored_programs, "_folder", lambda: tmp_path / "programs")
    for program in PROGRAMS:
        monkeypatch.setattr(program, "_ready", {})
    return tmp_path / "programs"


def prepared():
    return [len(program._ready) for program in PROGRAMS]


def run(simulator, candidate, record):
    for way in (simulator.run_and_jacobian, simulator.run):
        way(candidate, Data.of(record))


@pytest.mark.parametrize("own", [pytest.param(own, marks=pytest.mark.slow) for own in (False, True)])
def test_a_refit_runs_what_was_compiled_for_the_expected_model(case, kept, own):
    identified = jaxgray.identify(case)
    model = identified.model if own else None
    simulator, start = compiling.expected([case], diagnose.FORCES, model, {})
    spring = next(
        term
        for term in compiling.one_of_each_table(CATALOGUE, diagnose.FORCES, case)
        if term.effect.id == "cubic_stiffness"
    )
    run(simulator, start.with_terms((spring,)), case)
    before = prepared()
    assert before == [1, 1]
    baseline = baseline_of([case], None if own else identified, model)
    run(response.Simulator(baseline.setup, diagnose.FORCES), baseline.start.with_terms((spring,)), case)
    assert prepared() == before


def test_every_force_that_is_looked_for_has_its_table(case):
    terms = compiling.one_of_each_table(CATALOGUE, diagnose.FORCES, case)
    tables = {response.law_table((term,), diagnose.FORCES) for term in terms}
    assert {law for table in tables for law in table} == set(diagnose.FORCES) and len(tables) == len(terms)
    assert compiling.one_of_each_table((), diagnose.FORCES, case) == []


def test_nothing_is_begun_where_programs_are_not_kept_or_after_the_end(case, monkeypatch):
    begun = []
    monkeypatch.setattr(compiling, "expected", lambda *_: begun.append(threading.current_thread()) or 1 / 0)
    monkeypatch.setattr(compiling, "cores", lambda: 2)
    for keeps in (False, True):
        monkeypatch.setattr(compiling, "keeps_programs", lambda keeps=keeps: keeps)
        with compiling.compiling_ahead([case], diagnose.FORCES, CATALOGUE, None, {}):
            for thread in threading.enumerate():
                if thread.name == "jaxgray-ahead":
                    thread.join()
        # What fails there is not said: it fails again where it is asked for.
        assert len(begun) == keeps
    assert begun[0] is not threading.main_thread()
    assert jax.config.jax_enable_x64
