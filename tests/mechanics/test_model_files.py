"""A model on the screen and in files."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.mechanics.effects import CATALOGUE
from jaxgray.mechanics.effects.base import Term, places_of
from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.systems.drives import BaseAcceleration, BaseDisplacement, Force
from jaxgray.report.documents.export import load, save, write_json

NAMES = {"input_names": ["f"], "output_names": ["left", "right"], "output_units": ["mm", "mm"]}
R = jnp.asarray([[1.0], [1 / 3]])
MODELS = [
    {},
    {"drive": Force(R), "input_units": ["N"], **NAMES},
    {"drive": BaseAcceleration(R, True), "measured": ("velocity", "acceleration"), **NAMES},
    {"drive": BaseAcceleration(R), "measured": "acceleration"},
    {"drive": BaseDisplacement(R, False), "measured": ("displacement", "velocity")},
]


@pytest.mark.parametrize("ending", [".json", ".npz"])
@pytest.mark.parametrize("options", MODELS)
def test_round_trip_is_exact(matrices, tmp_path, options, ending):
    model = MechanicalModel(*(X / 3 for X in matrices), **options)
    path = tmp_path / f"model{ending}"
    save(SimpleNamespace(model=model), path)
    found = load(path)
    for name in ("mass", "damping", "stiffness"):
        np.testing.assert_array_equal(getattr(found, name), getattr(model, name))
    assert type(found.drive) is type(model.drive)
    assert getattr(found.drive, "relative", None) == getattr(model.drive, "relative", None)
    direction = "input_map" if isinstance(model.drive, Force) else "direction"
    np.testing.assert_array_equal(getattr(found.drive, direction), getattr(model.drive, direction))
    for name in ("measured", "input_names", "output_names", "input_units", "output_units"):
        assert getattr(found, name) == getattr(model, name)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_schema(model, tmp_path):
    save(model, tmp_path / "model.json")
    document = json.loads((tmp_path / "model.json").read_text())
    assert document["schema"] == "jaxgray/model/1"
    assert document["input_map"] == [[1.0, 0.0], [0.0, 1.0]] and "base" not in document
    assert document["measured"] == ["displacement", "displacement"]


@pytest.mark.parametrize(
    ("wrap", "stiffness"),
    [
        (lambda a, b: a, 100.0),
        (lambda a, b: {"model": a, "fit_percent": {}}, 100.0),
        (lambda a, b: {"baseline": {"model": a}, "extended": None}, 100.0),
        (lambda a, b: {"baseline": {"model": a}, "extended": {"model": b}}, 90.0),
    ],
)
def test_where_a_model_may_stand(matrices, tmp_path, wrap, stiffness):
    M, D, K = matrices
    plain = {"mass": M, "damping": D, "stiffness": K, "standard_errors": {"mass": np.nan * M}}
    better = plain | {"stiffness": K - 10 * np.eye(2), "input_map": [[1.0], [0.0]]}
    write_json(wrap(plain, better), tmp_path / "any.json")
    found = load(tmp_path / "any.json")
    assert found.stiffness[0, 0] == stiffness
    assert found.inputs == (1 if stiffness == 90.0 else 2)


GOOD = {"mass": [[1.0]], "damping": [[1.0]], "stiffness": [[1.0]]}


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"mass": [[1.0]], "stiffness": [[1.0]]}, "damping missing"),
        ({"fit": 3}, "no model in it; give 'mass', 'damping' and 'stiffness'"),
        ([1, 2], "the top is a list"),
        (GOOD | {"stiffness": [[1.0, 2.0]]}, r"stiffness has shape \(1, 2\); give a square matrix"),
        (GOOD | {"damping": [[None]]}, r"damping\[0,0\] is nan; give finite numbers"),
        (GOOD | {"damping": [["a"]]}, "damping is not a matrix of numbers"),
        (GOOD | {"mass": [[1.0, 2.0], [3.0]]}, "mass is not a matrix of numbers"),
        (GOOD | {"mass": [[1.0, 2.0], [0.5, 9.0]]}, r"mass is not symmetric: \[0,1\] is 2, \[1,0\] is 0.5"),
        (GOOD | {"mass": [[-1.0]]}, "mass has the eigenvalue -1; give a positive definite"),
        (GOOD | {"mass": [[1.0, 0.0], [0.0, 1.0]]}, "damping has shape"),
        (GOOD | {"input_map": [[1.0], [0.0]]}, "input_map has 2 rows"),
        (GOOD | {"base": {"kind": "rocking"}}, "base is .* 'kind' "),
        (GOOD | {"output_names": "y"}, "output_names is 'y'; give a list of texts"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, document, message):
    path = tmp_path / "model.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=message) as caught:
        load(path)
    assert str(path) in str(caught.value)


def test_wrong_files(model, tmp_path):
    with pytest.raises(ValueError, match="none.json does not exist"):
        load(tmp_path / "none.json")
    for name, message in (
        ("a.json", "this is not JSON"),
        ("a.npz", "no NPZ file"),
        ("a.txt", "the ending"),
    ):
        (tmp_path / name).write_text("{")
        with pytest.raises(ValueError, match=message):
            load(tmp_path / name)
    with pytest.raises(ValueError, match="the folder .* is not there"):
        save(model, tmp_path / "nowhere" / "model.json")


@pytest.mark.parametrize("ending", ["json", "npz"])
def test_effects_come_back_with_their_places_and_parameters(tmp_path, ending):
    terms = []
    for effect in CATALOGUE:
        place = places_of(effect, ("u1", "u2"), ("y1", "y2"))[-1]
        values = [1 if parameter.choices else 0.1 * (k + 1) for k, parameter in enumerate(effect.parameters)]
        terms.append(Term(effect, place, np.array(values, dtype=float)))
    path = tmp_path / f"model.{ending}"
    save(MechanicalModel(np.eye(2), np.eye(2), np.eye(2), effects=terms), path)
    for before, after in zip(terms, load(path).effects, strict=True):
        assert (before.effect, before.place) == (after.effect, after.place)
        np.testing.assert_array_equal(before.values, after.values)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"effect": "cubic_stifness"}, "did you mean cubic_stiffness"),
        ({"location": "y3"}, "cannot act at 'y3'"),
        ({"parameters": {}}, "lacks the parameter k3"),
        ({"parameters": {"k3": "much"}}, "give a finite number"),
    ],
)
def test_a_wrong_effect_in_a_file_is_named(tmp_path, change, message):
    effect = {"effect": "cubic_stiffness", "location": "y1", "parameters": {"k3": 2.0}} | change
    matrices = {name: [[1.0]] for name in ("mass", "damping", "stiffness")}
    path = tmp_path / "model.json"
    path.write_text(json.dumps(matrices | {"effects": [effect]}))
    with pytest.raises(ValueError, match=message):
        load(path)


def test_json_is_strict_and_whole(tmp_path):
    path = tmp_path / "any.json"
    write_json(
        {
            "a": np.float64(np.nan),
            "b": jnp.asarray([1.0, jnp.inf]),
            "c": (np.int64(3), True, None, np.bool_(False)),
            3: {"é": -np.inf},
        },
        path,
    )
    before = path.read_text()
    assert json.loads(before) == {"a": None, "b": [1.0, None], "c": [3, True, None, False], "3": {"é": None}}
    with pytest.raises(ValueError, match=r"deep\[1\] is a object"):
        write_json({"deep": [1, object()]}, path)
    assert path.read_text() == before and len(list(tmp_path.iterdir())) == 1


def test_one_screen(matrices):
    text = repr(MechanicalModel(*matrices, input_units=["N"] * 2, output_units=["mm/s"] * 2, measured="velocity"))
    for part in ("mass [N s^2/mm]", "damping [N s/mm]", "stiffness [N/mm]", "y1 [mm/s] velocity", "u2 [N]"):
        assert part in text
    assert len(text.splitlines()) < 20
    base = repr(MechanicalModel(*matrices, drive=BaseAcceleration(R, True)))
    assert "relative to the base" in base and "mass\n" in base
