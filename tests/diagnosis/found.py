"""How a hidden effect is looked for in the tests, and what counts as found."""

import warnings

import hidden
import hidden_draws
import numpy as np

import jaxgray

SAMPLES = 2000
SEED = 20
IDS = hidden_draws.DYNAMIC

WHOLE = (
    "cubic_stiffness",
    "coulomb_friction",
    "bouc_wen_hysteresis",
    "gyroscopic_coupling",
    "input_delay",
    "sensor_offset",
    "unmodelled_mode",
    "force_step",
)
"""One of every family, looked for with the whole catalogue; the others among their relatives and these."""


def searched(effect_id):
    """Ids to look for; None for all."""
    if effect_id in WHOLE:
        return None
    family = {effect.id: effect.family for effect in jaxgray.CATALOGUE}
    return [i for i in family if i in WHOLE or family[i] == family[effect_id]]


def generator(*words):
    """Random numbers that depend on some words alone."""
    return np.random.default_rng([SEED, *(ord(letter) for word in words for letter in word)])


def hidden_case(effect_id, *, dofs=(2,), excess=(1.5, 3.0)):
    """A random system with one hidden effect, from the independent simulator."""
    rng = generator(effect_id, str(dofs))
    return hidden.random_case(rng, effect_id, dofs=dofs, samples=SAMPLES, excess=excess)


def records_of(case):
    """Estimation and validation record of a case."""
    estimation = jaxgray.Record(case.u, case.y, case.sampling_time, hold=case.hold, scheduling=case.scheduling)
    validation = jaxgray.Record(case.u_v, case.y_v, case.sampling_time, hold=case.hold, scheduling=case.scheduling_v)
    return estimation, validation


def diagnosed(case, **options):
    """What is said about the records of a case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        estimation, validation = records_of(case)
        return jaxgray.diagnose(estimation, validation=validation, **options)


def model_findings(diagnosis):
    """Findings that say what the simulation gets wrong."""
    return [finding for finding in diagnosis.findings if finding.stage == "model"]


def record_findings(diagnosis):
    """Ids of what the raw record shows."""
    return {finding.effect for finding in diagnosis.findings if finding.stage == "record"}


def explains(finding, effect):
    """Whether an effect, at its place, is in the class of a finding."""
    return any(member.effect == effect.id and effect.place in ("record", member.location) for member in finding.members)


def check_found(case, diagnosis):
    """One finding, the hidden effect in its class at its place, all but noise explained, on unseen data as well."""
    (effect,) = case.effects
    (finding,) = model_findings(diagnosis)
    said = str(diagnosis)
    assert explains(finding, effect), said
    # What the linear fit warns of is mended.
    if diagnosis.identification is not None:
        assert not set(diagnosis.identification.misfits) & set(diagnosis.warnings), said
    assert diagnosis.verdict in ("named", "equivalent"), said
    assert len(finding.members) <= 4
    # One law, named by how much of the record is spent in contact.
    assert not {"dead_zone_stiffness", "end_stop"} <= {member.effect for member in finding.members}, said
    ratio = np.array(list(diagnosis.noise_floor.values())) / case.noise
    assert np.all(np.abs(ratio - 1) < 0.25), said
    assert diagnosis.gain == finding.gain and finding.gain.ci99_lower > 0, said
    if finding.effect == effect.id:
        for name, value in effect.parameters.items():
            check_parameter(finding.parameters.get(name), value, name, said)
    if diagnosis.energy is not None:
        assert diagnosis.energy.error < 0.01 and not any(law.creates for law in diagnosis.energy.laws)


def check_parameter(estimate, true, name, said):
    """A parameter within five standard errors of the truth and 1 %, where both are single numbers."""
    if estimate is None or estimate.standard_error is None or np.ndim(true) or isinstance(true, str):
        return
    if name == "phase" or np.ndim(estimate.value):
        return
    assert abs(estimate.value - true) <= 5 * estimate.standard_error + 0.01 * abs(true), f"{name}: {true}\n{said}"
