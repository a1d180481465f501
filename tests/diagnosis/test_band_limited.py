"""An input that was measured behind an anti-alias filter is neither held nor straight between its samples."""

import hidden
import numpy as np
import pytest
from found import model_findings
from independent import simulate

import jaxgray
from jaxgray.mechanics.fitted_run import fitted_run
from jaxgray.mechanics.systems.drives import Force

FINER, SAMPLES, TIME = 16, 2000, 0.01
SYSTEM = hidden.System(np.diag([2.0, 1.0]), np.diag([3.0, 1.0]), np.array([[6000.0, -2000.0], [-2000.0, 4000.0]]))


def measured_pair(rng, band, noise=0.003, hold="linear", measured="displacement"):
    """Two records whose force has no frequency beyond `band` cycles a sample, simulated on a grid 16 times finer."""
    records = []
    for _ in range(2):
        count = (SAMPLES + 200) * FINER
        spectrum = np.fft.rfft(rng.standard_normal((count, 1)), axis=0)
        spectrum[np.fft.rfftfreq(count) * FINER > band] = 0.0
        u = np.fft.irfft(spectrum, count, axis=0)[: SAMPLES * FINER]
        u /= u.std()
        y = simulate(
            SYSTEM.M, SYSTEM.D, SYSTEM.K, u, TIME / FINER, E=np.eye(2)[:, :1], hold="linear", measured=measured
        )
        u, y = u[::FINER], y[::FINER]
        y = y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape)
        records.append(jaxgray.Record(u, y, TIME, hold=hold, measured=measured))
    return records


@pytest.mark.slow
def test_a_band_limited_input_is_named():
    estimation, validation = measured_pair(np.random.default_rng(3), 0.35)
    diagnosis = jaxgray.diagnose(estimation, validation=validation)
    (finding,) = model_findings(diagnosis)
    assert (finding.effect, finding.location) == ("band_limited_input", "u1"), str(diagnosis)
    share = finding.parameters["share"]
    assert share.value == pytest.approx(1.0, abs=3 * share.standard_error)
    assert diagnosis.excess < 1.02


@pytest.mark.parametrize(("measured", "most"), [("displacement", 2e-3), ("velocity", 2e-2)])
def test_a_record_said_to_be_band_limited_is_simulated_so(measured, most):
    model = jaxgray.MechanicalModel(SYSTEM.M, SYSTEM.D, SYSTEM.K, drive=Force(np.eye(2)[:, :1]), measured=measured)
    off = []
    for hold in ("band-limited", "linear"):
        record, _ = measured_pair(np.random.default_rng(3), 0.3, noise=0.0, hold=hold, measured=measured)
        assert record.hold == "linear"
        run = fitted_run(model, record).simulated
        off.append(np.std((run - record.y)[100:-100]) / np.std(record.y))
    assert off[0] < most
    assert off[0] < 0.2 * off[1]


def test_accelerometers_refuse_a_band_limited_input():
    with pytest.raises(ValueError, match="hold is 'band-limited' and measured holds accelerations"):
        jaxgray.Record(np.ones(5), np.ones(5), 0.1, hold="band-limited", measured="acceleration")
