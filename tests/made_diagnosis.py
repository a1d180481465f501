"""A diagnosis made by hand, of two coordinates with friction at the first, to be changed by the tests."""

import dataclasses

import numpy as np

from jaxgray import MechanicalModel, Record
from jaxgray.diagnosis.findings import (
    Curves,
    Estimate,
    Finding,
    Gain,
    Member,
    ModelSummary,
    NextExperiment,
    NotFound,
    ParameterShift,
    Rejected,
)
from jaxgray.diagnosis.result import Diagnosis
from jaxgray.mechanics.effects import Place, Term, by_id

SAMPLES = 400
FLOOR = {"y1": 1e-3, "y2": 2e-3}
FORCE = {"Fc": Estimate(0.2412, 0.0023, "N"), "eps": Estimate(0.001, None, "m/s")}


def record(seed, samples=SAMPLES):
    """Random inputs and outputs with names and units."""
    rng = np.random.default_rng(seed)
    units = {"input_units": ("N", "N"), "output_units": ("m", "m")}
    return Record(rng.standard_normal((samples, 2)), rng.standard_normal((samples, 2)), 0.01, **units)


def model(damping):
    """Two coordinates, in N and m."""
    M, D, K = np.diag([2.0, 1.0]), np.diag([damping, 1.0]), np.array([[100.0, -5.0], [-5.0, 100.0]])
    return MechanicalModel(M, D, K, input_units=("N", "N"), output_units=("m", "m"))


def summary(damping, first, second):
    """Free-run errors of both outputs, in units of the noise floor."""
    rmse = {"y1": first * FLOOR["y1"], "y2": second * FLOOR["y2"]}
    fit = {"y1": 80.0, "y2": 90.0}
    errors = {name: np.full((2, 2), 0.01) for name in ("mass", "damping", "stiffness")}
    both = ("estimation", "validation")
    return ModelSummary(model(damping), errors, dict.fromkeys(both, fit), dict.fromkeys(both, rmse))


GAIN = Gain({"y1": (2.8e-3, 1e-3), "y2": (2.1e-3, 2e-3)}, 64.2, (61.1, 66.8), 60.0, True)


def member(effect, location, parameters, delta_bic=0.0):
    return Member(effect, location, delta_bic, parameters)


FRICTION = Finding(
    "coulomb_friction",
    "y1",
    "named",
    "model",
    (member("coulomb_friction", "y1", FORCE),),
    FORCE,
    2500.4,
    GAIN,
)


def diagnosis(**changes):
    """Friction at y1, found and proven; `changes` of its fields."""
    records = record(1), record(2)
    curves = Curves(records[1].time, records[1].y, 0.9 * records[1].y, 0.99 * records[1].y, True)
    term = Term(by_id("coulomb_friction"), Place("y1", 0), np.array([0.2412, 0.001]))
    made = Diagnosis(
        verdict="named",
        baseline=summary(3.39, 2.8, 1.05),
        noise_floor=dict(FLOOR),
        noise_floor_source="residual of the final model",
        findings=(FRICTION,),
        extended=summary(3.0, 1.0, 1.0),
        gain=GAIN,
        excess=1.0,
        baseline_excess=2.1,
        white=True,
        explainable=None,
        depends_on=(),
        rejected=(
            Rejected("stribeck_friction", "y1", 2481.0, "explained better by coulomb_friction at y1 (by 19)"),
            Rejected("dahl_friction", "y1", float("nan"), "its refit could not be simulated"),
        ),
        not_found=(
            NotFound("sensor_lag", "y1", {"tau": Estimate(0.00123, None, "s")}),
            NotFound("cubic_stiffness", "y1-y2", {"k3": Estimate(1306.9, None, "N/m^3")}),
            NotFound("play_hysteresis", "u1", {"w": Estimate((0.05, float("nan")), None, "")}),
        ),
        shifts=(
            ParameterShift("mass[0,0]", 2.001, 2.0, 0.01),
            ParameterShift("damping[0,0]", 3.39, 3.0, 0.01),
            ParameterShift("damping[0,1]", 0.3, 0.0, 0.01),
        ),
        budget={"coulomb_friction at y1": 87.0, "noise": 12.5, "unexplained": 0.5},
        next_experiment=None,
        warnings=("Poor fit at y2.",),
        records=records[:1],
        validation_records=records[1:],
        curves=(curves,),
        identification=None,
        terms=(term,),
    )
    return dataclasses.replace(made, **changes)


def experiment(samples=50):
    """An input that separates two members."""
    u = np.random.default_rng(5).standard_normal((samples, 2))
    return NextExperiment(("constant_force", "sensor_offset"), u, 0.01, 250.0, 3.0, "Drive u1 with slow steps.")


def equivalent(**changes):
    """A constant force that could be an offset as well."""
    force, offset = {"f0": Estimate(0.1, 0.01, "N")}, {"b": Estimate(-1e-3, 1e-4, "m")}
    members = member("constant_force", "y1", force), member("sensor_offset", "y1", offset, -2.5)
    finding = Finding("constant_force", "y1", "equivalent", "model", members, force, 80.0, GAIN)
    return diagnosis(
        **{"verdict": "equivalent", "findings": (finding,), "shifts": (), "next_experiment": experiment()} | changes
    )


def nothing(verdict="noise", excess=1.02, **changes):
    """No effect found: noise, or unexplained."""
    empty = {"findings": (), "extended": None, "gain": None, "shifts": (), "budget": {}, "terms": ()}
    fields = {"verdict": verdict, "excess": excess, "baseline": summary(3.0, excess, 1.0)}
    return diagnosis(**empty | fields | changes)


def wrong_numbers(**changes):
    """The user's own model with a wrong stiffness, and friction besides."""
    delta = {"delta": Estimate(-3.04, 0.018, "N/m")}
    numbers = Finding(
        "stiffness_error", "y1", "named", "model", (member("stiffness_error", "y1", delta),), delta, 99.0, GAIN
    )
    return diagnosis(**{"own_model": True, "findings": (FRICTION, numbers)} | changes)
