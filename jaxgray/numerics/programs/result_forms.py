"""What a compiled program returns, as text: tuples, lists, mappings and classes of this package around its arrays.

A form that is read makes no object but of these, and runs nothing: unlike a pickle, which may call anything.
"""

import dataclasses
import importlib
import json

import equinox as eqx
import jax

PACKAGE = __name__.split(".")[0]


class Unknown(ValueError):
    """Something in a form that is not written as text."""


def form_text(form: jax.tree_util.PyTreeDef) -> str:
    """One line for a form.

    **Raises:** `Unknown` where it holds what could not be read again.
    """
    text = json.dumps(_written(jax.tree_util.tree_unflatten(form, range(form.num_leaves))))
    if form_of(text) != form:
        raise Unknown(f"{form} does not come back from text")
    return text


def form_of(text: str) -> jax.tree_util.PyTreeDef:
    """The form that `form_text` wrote.

    **Raises:** `Unknown` or another `ValueError` for any other text.
    """
    return jax.tree_util.tree_structure(_read(json.loads(text)))


def _written(value):
    """Lists [kind, …] for what holds something, None for itself, a number for an array."""
    if value is None or type(value) is int:
        return value
    if type(value) in (tuple, list):
        return [type(value).__name__, [_written(one) for one in value]]
    if type(value) is dict and all(type(key) is str for key in value):
        return ["dict", {key: _written(one) for key, one in value.items()}]
    kind = type(value)
    name = [kind.__module__, kind.__qualname__]
    _check_class(kind)
    if issubclass(kind, tuple):
        return ["class", name, {field: _written(one) for field, one in zip(kind._fields, value)}]
    parts = {}
    for field in dataclasses.fields(kind):
        one = getattr(value, field.name)
        parts[field.name] = ["static", _static(one)] if field.metadata.get("static") else _written(one)
    return ["class", name, parts]


def _static(value):
    if value is None or type(value) in (str, int, float, bool):
        return value
    if type(value) is tuple:
        return [_static(one) for one in value]
    raise Unknown(f"{value!r} is no text, number or tuple of these")


def _read(text):
    if text is None or type(text) is int:
        return text
    kind, *rest = text
    if kind in ("tuple", "list"):
        return (tuple if kind == "tuple" else list)(_read(one) for one in rest[0])
    if kind == "dict":
        return {key: _read(one) for key, one in rest[0].items()}
    if kind == "static":
        return _read_static(rest[0])
    if kind != "class":
        raise Unknown(f"{kind!r} is no form")
    (module, name), parts = rest
    if module.split(".")[0] != PACKAGE or not name.isidentifier():
        raise Unknown(f"{module}.{name} is not of this package")
    cls = getattr(importlib.import_module(module), name, None)
    _check_class(cls)
    parts = {field: _read(one) for field, one in parts.items()}
    if issubclass(cls, tuple):
        return cls(**parts)
    made = object.__new__(cls)
    for field in dataclasses.fields(cls):
        object.__setattr__(made, field.name, parts[field.name])
    return made


def _read_static(value):
    return tuple(_read_static(one) for one in value) if isinstance(value, list) else value


def _check_class(cls) -> None:
    known = isinstance(cls, type) and cls.__module__.split(".")[0] == PACKAGE
    if not known or not (issubclass(cls, eqx.Module) or (issubclass(cls, tuple) and hasattr(cls, "_fields"))):
        raise Unknown(f"{cls!r} is no module or named tuple of this package")
