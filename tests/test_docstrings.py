"""Every public function has an example in its docstring, which runs as it stands."""

import doctest
import inspect

import pytest

import jaxgray

MADE = {"MechanicalModel", "Record", "StateSpace", "Force", "BaseAcceleration", "BaseDisplacement", "RowWeights"}
"""Classes that users make themselves; of the others the functions give them."""

FUNCTIONS = sorted(name for name in jaxgray.__all__ if inspect.isfunction(getattr(jaxgray, name)))
PARSER = doctest.DocTestParser()


def example(name):
    value = getattr(jaxgray, name)
    return PARSER.get_doctest(inspect.getdoc(value), {}, f"jaxgray.{name}", inspect.getfile(inspect.unwrap(value)), 0)


@pytest.mark.parametrize("name", [*FUNCTIONS, *sorted(MADE), "MujocoSimulator"])
def test_the_example_runs(name, monkeypatch, tmp_path):
    if name == "MujocoSimulator":
        pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    test = example(name)
    said = []
    found = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    assert found.failed == 0, "".join(said)
    # It shows something, and does not just run.
    assert any(one.want for one in test.examples)


def test_an_example_that_is_wrong_fails(monkeypatch):
    monkeypatch.setattr(jaxgray.schema, "__doc__", ">>> 1 + 1\n3\n")
    assert doctest.DocTestRunner(verbose=False).run(example("schema"), out=lambda _: None).failed == 1


def test_the_names_that_are_offered_are_those_that_a_user_needs():
    offered = set(dir(jaxgray))
    assert offered == {*jaxgray.__all__, "__version__"}
    assert all(getattr(jaxgray, name) is not None for name in offered)
    assert offered.isdisjoint({"TYPE_CHECKING", "importlib", "numerics", "_HOMES"})
