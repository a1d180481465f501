"""Damage in one storey of a frame on a shaken base, seen by accelerometers on every floor."""

import frames
import hidden_laws
import numpy as np
import pytest

import jaxgray

H = 0.01


def shaken(effect, samples=3000):
    frame = frames.Frame((120.0, 90.0), (1.9e5, 1.5e5), (90.0, 70.0))
    rng = np.random.default_rng(11)
    u = 1.2 * frames.band_noise(rng, samples, 1, (0.5, 12.0), H)
    clean = frames.shaken_with(frame, u, H, [effect])[0]
    y = clean + 3e-3 * clean.std() * rng.standard_normal(clean.shape)
    units = {"input_units": ["m/s^2"], "output_units": ["m/s^2"] * 2, "output_names": ["floor1", "floor2"]}
    return frame, jaxgray.Record(u, y, H, hold="linear", measured="acceleration", **units)


@pytest.mark.slow
def test_a_loss_of_stiffness_in_one_storey_is_dated_and_told_in_percent(tmp_path):
    frame, record = shaken(hidden_laws.Effect("stiffness_step", "y1-y2", {"dk": -0.1 * 1.5e5, "t0": 11.237}))
    found = jaxgray.diagnose(record, excitation="base-acceleration")
    assert [(f.effect, f.location) for f in found.findings if f.stage == "model"] == [
        ("stiffness_step", "floor1-floor2")
    ]
    values = found.findings[-1].parameters
    assert abs(values["t0"].value - 11.237) < 3 * values["t0"].standard_error < 0.02
    assert abs(values["dk"].value + 0.1 * 1.5e5 / frame.masses[0]) < 3.5 * values["dk"].standard_error
    assert found.excess < 1.05
    assert "The stiffness between floor1 and floor2 fell by 10 %." in found.sentence
    jaxgray.write_report(found, tmp_path / "page.html")
    assert "on the drift of that storey" in (tmp_path / "page.html").read_text()


@pytest.mark.slow
def test_dry_friction_in_one_storey_holds_on_held_out_data():
    # Held-out data begin while the storey may be at rest away from zero: from rest at zero no slope leads there.
    frame, record = shaken(hidden_laws.Effect("coulomb_friction", "y1-y2", {"Fc": 90.0}))
    laws = "coulomb_friction,cubic_stiffness,bilinear_stiffness"
    found = jaxgray.diagnose(record, excitation="base-acceleration", only=laws)
    assert [(f.effect, f.location) for f in found.findings if f.stage == "model"] == [
        ("coulomb_friction", "floor1-floor2")
    ]
    assert abs(found.findings[-1].parameters["Fc"].value / (90.0 / frame.masses[0]) - 1) < 0.01
    assert found.gain.held_out and found.gain.ci99_lower > 80.0
