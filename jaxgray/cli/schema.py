"""The command for the JSON Schema of the documents that are written."""

import json

import typer


def schema(
    name: str | None = typer.Argument(None, metavar="[NAME]", help="Such as diagnosis, or jaxgray/diagnosis/1."),
) -> None:
    """Print the JSON Schema of a kind of document; without a name, list the kinds."""
    from .. import schemas

    if name is None:
        print("\n".join(schemas.names()))
        return
    known = schemas.names()
    # The kind alone stands for its highest version.
    print(json.dumps(schemas.schema(next((one for one in known[::-1] if one.split("/")[1] == name), name)), indent=1))
