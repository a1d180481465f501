"""The gallery shows what its examples find: they run as they stand, and the files of the manual hold what comes out."""

import json
import re

import numpy as np
import pytest
from shown import ROOT, example

from jaxgray.manual.gallery import FILES, ORDER, write_gallery

NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


def kept(name):
    return json.loads((FILES / f"{name}.json").read_text(encoding="utf-8"))


def made(name, tmp_path, *options):
    """What an example returns, once what it shows is what the manual has."""
    path = tmp_path / f"{name}.json"
    found = example(name).main([*options, "--gallery", str(path)])
    agree(json.loads(path.read_text(encoding="utf-8")), kept(name))
    return found


def agree(now, before):
    """Words are the same, and curves and numbers nearly so."""
    assert [row for row in words(now["table"])] == [row for row in words(before["table"])]
    for panel, old in zip(now["panels"], before["panels"], strict=True):
        assert {k: v for k, v in panel.items() if k != "curves"} == {k: v for k, v in old.items() if k != "curves"}
        for curve, other in zip(panel["curves"], old["curves"], strict=True):
            assert curve["label"] == other["label"]
            size = np.ptp(other["y"])
            np.testing.assert_allclose(curve["y"], other["y"], atol=0.02 * size)


def words(table):
    return [[re.sub(NUMBER, "#", cell) for cell in row] for row in table]


def test_every_file_has_its_example_and_its_place():
    assert {path.stem for path in FILES.glob("*.json")} == set(ORDER)
    assert all((ROOT / "examples" / f"{name}.py").is_file() for name in ORDER)
    assert sum(path.stat().st_size for path in FILES.iterdir()) < 400_000


def test_the_page_has_a_section_and_a_picture_for_each(tmp_path):
    write_gallery(tmp_path)
    text = (tmp_path / "gallery.md").read_text(encoding="utf-8")
    for name in ORDER:
        assert f"## {kept(name)['title']}\n" in text and f"(gallery/{name}.svg)" in text
        assert (tmp_path / "gallery" / f"{name}.svg").read_bytes().startswith(b"<?xml")


def test_curves_that_differ_and_other_words_are_noticed():
    before = kept("building")
    changed = json.loads(json.dumps(before))
    agree(changed, before)
    changed["panels"][0]["curves"][1]["y"][7] += 0.1 * np.ptp(changed["panels"][0]["curves"][1]["y"])
    with pytest.raises(AssertionError):
        agree(changed, before)
    changed = json.loads(json.dumps(before))
    changed["table"][1][0] = "another model"
    with pytest.raises(AssertionError):
        agree(changed, before)


def model_findings(found):
    return [one for one in found.findings if one.stage == "model"]


PLAY = "play_hysteresis"


@pytest.mark.slow
def test_hysteresis_of_both_piezo_actuators_is_named(tmp_path):
    manipulator = example("micro_manipulator")
    found = made("micro_manipulator", tmp_path, "--piezo")
    first, second, *others = model_findings(found)
    assert {(one.effect, one.location) for one in (first, second)} == {(PLAY, "u1"), (PLAY, "u2")}
    # What the thresholds of the second leave may be taken for a law of its own, which explains next to nothing.
    assert sum(one.gain.percent for one in others) < 5 < 15 < second.gain.percent
    weights, thresholds = (first.parameters[name] for name in ("w", "r"))
    order = np.argsort(thresholds.value)
    np.testing.assert_allclose(np.take(thresholds.value, order), manipulator.THRESHOLDS, atol=0.03)
    np.testing.assert_allclose(np.take(weights.value, order), manipulator.WEIGHTS, atol=0.06)
    linear, extended = (tuple(part.fit_percent["validation"].values()) for part in (found.baseline, found.extended))
    assert max(linear) < 90 and min(extended) > 97
    frequencies = found.extended.model.modes().natural_frequency_hz
    assert frequencies == pytest.approx(manipulator.FREQUENCIES_HZ, rel=2e-4)


@pytest.mark.slow
def test_friction_and_backlash_of_a_drive_are_named(tmp_path):
    drive = example("drive")
    found = made("drive", tmp_path)
    friction, play = model_findings(found)
    assert (friction.effect, friction.location) == ("coulomb_friction", "motor")
    assert (play.effect, play.location) == ("dead_zone_stiffness", "motor-load")
    for finding, name, true in ((friction, "Fc", drive.FRICTION), (play, "gap", drive.GAP), (play, "k", drive.SHAFT)):
        one = finding.parameters[name]
        assert abs(one.value - true) < 4.5 * one.standard_error < 0.02 * true, str(found)


@pytest.mark.slow
def test_a_friction_damper_of_a_building_is_named(tmp_path):
    building = example("building")
    (finding,) = model_findings(made("building", tmp_path))
    assert (finding.effect, finding.location) == ("coulomb_friction", "floor1")
    assert finding.parameters["Fc"].value == pytest.approx(building.FRICTION, rel=0.02)


@pytest.mark.slow
def test_two_of_six_drives_change_and_no_other(tmp_path):
    fleet = example("fleet_of_drives")
    drifts = made("fleet_of_drives", tmp_path).drifts
    assert {drift.machine for drift in drifts} == {f"drive{k + 1}" for k in (fleet.RUBS, fleet.REPLACED)}
    (spring,) = [drift for drift in drifts if drift.name == "stiffness[0,0]"]
    assert spring.change.begins == fleet.SINCE
    assert spring.relative == pytest.approx(fleet.SOFTER - 1, abs=0.003)
    assert any(drift.name.startswith("coulomb_friction") for drift in drifts)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper_simulation", "learned_force"])
def test_the_other_examples_show_what_the_manual_has(name, tmp_path):
    assert made(name, tmp_path)
