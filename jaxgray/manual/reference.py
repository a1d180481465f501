"""The page of the public names, which mkdocstrings fills with their signatures and docstrings."""

import jaxgray

SECTIONS = {
    "Records": ("Record", "RecordWarning", "read_record", "preflight"),
    "Identification": ("identify", "Identification", "sweep", "Sweep", "stabilisation", "Stabilisation"),
    "Diagnosis": ("diagnose", "Diagnosis", "CATALOGUE"),
    "Models": ("MechanicalModel", "StateSpace", "Force", "BaseAcceleration", "BaseDisplacement", "energy_balance"),
    "Files and exports": (
        "load",
        "save",
        "export",
        "to_control",
        "to_scipy",
        "write_report",
        "write_simulation",
        "schema",
    ),
    "Many and long records": ("identify_many", "Identifications", "fleet", "compress", "CompressedRecord"),
    "Inside other programs": ("estimate", "Estimate", "RowWeights", "RESULTS", "ComputationError"),
    "Simulators of other programs": ("FmuSimulator", "MujocoSimulator"),
}

OTHERS = "Others"

INTRODUCTION = """# Python reference

Every name that `import jaxgray` offers, by what it is for; `dir(jaxgray)` lists the same. Names are fetched when they
are first used, so that the import is quick. All examples run as they stand once 64-bit floats are on:
`jax.config.update("jax_enable_x64", True)`.
"""


def reference_page() -> str:
    """The page in markdown: a section for each purpose, in it the names with what mkdocstrings is to look up."""
    known = {name for names in SECTIONS.values() for name in names}
    left = tuple(name for name in jaxgray.__all__ if name not in known)
    parts = [INTRODUCTION]
    for title, names in {**SECTIONS, OTHERS: left}.items():
        if names:
            parts += [f"## {title}", *(_entry(name) for name in names)]
    return "\n\n".join(parts) + "\n"


def _entry(name: str) -> str:
    return "\n".join(
        [
            f"::: {_path(name)}",
            "    options:",
            f"      heading: jaxgray.{name}",
            f"      toc_label: {name}",
        ]
    )


def _path(name: str) -> str:
    """Where a name is defined: a function may be called as its module, which would be found in its place."""
    value = getattr(jaxgray, name)
    if isinstance(value, type) or callable(value):
        return f"{value.__module__}.{value.__qualname__}"
    home = next(home for home, names in jaxgray._HOMES.items() if name in names)
    return f"jaxgray.{home}.{name}"
