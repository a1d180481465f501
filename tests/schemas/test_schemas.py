"""The schemas are schemas, there is one for every document, and they refuse what is damaged."""

import copy
import json
import re
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest
from documents import Documents, validator
from made_diagnosis import diagnosis

import jaxgray
from jaxgray import schemas
from jaxgray.cli import main
from jaxgray.report import notebook
from jaxgray.report.documents import export
from jaxgray.report.documents.catalogue import catalogue_document
from jaxgray.report.documents.diagnosis import diagnosis_document
from jaxgray.report.page import whole as page

PACKAGE = Path(jaxgray.__file__).parent


@pytest.mark.parametrize("name", schemas.names())
def test_every_schema_is_one_and_complete_in_itself(name):
    schema = schemas.schema(name)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$schema"].endswith("2020-12/schema") and schema["properties"]["schema"] == {"const": name}
    assert schema["additionalProperties"] is False and schema["description"]
    # A reference that leads nowhere shows only when it is followed.
    references = set(re.findall(r'"\$ref": "([^"]+)"', json.dumps(schema)))
    assert references <= {f"#/$defs/{key}" for key in schema.get("$defs", {})}


def test_every_document_of_the_code_has_its_schema():
    texts = "\n".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    assert set(re.findall(r'"(jaxgray/[a-z-]+/\d+)"', texts)) == set(schemas.names())


def test_a_name_that_no_document_has_is_refused():
    with pytest.raises(ValueError, match="give one of jaxgray/diagnosis/1"):
        schemas.schema("jaxgray/diagnoses/1")


def without(key):
    return lambda document: document.pop(key)


def with_one_more(document):
    document["findings"][0]["certainty"] = 1.0


def with_another_verdict(document):
    document["verdict"] = "maybe"


def with_another_stage(document):
    document["findings"][0]["stage"] = "end"


def with_a_text_for_a_number(document):
    document["baseline"]["model"]["mass"][0][0] = "5.0"


def with_both_drives(document):
    document["baseline"]["model"]["base"] = {"kind": "acceleration", "direction": [[1.0]], "relative": False}


@pytest.mark.parametrize(
    "damage",
    [
        without("verdict"),
        without("findings"),
        with_one_more,
        with_another_verdict,
        with_another_stage,
        with_a_text_for_a_number,
        with_both_drives,
    ],
)
def test_a_damaged_diagnosis_is_refused(damage):
    whole = diagnosis_document(diagnosis())
    judge = validator("jaxgray/diagnosis/1")
    judge.validate(whole)
    damaged = copy.deepcopy(whole)
    damage(damaged)
    assert not judge.is_valid(damaged)


@pytest.mark.parametrize("name", schemas.names())
def test_a_document_with_nothing_in_it_is_refused(name):
    assert not validator(name).is_valid({"schema": name})


def test_what_the_tests_write_is_watched():
    assert page.plain is notebook.plain is export.plain and export.plain.__wrapped__
    found = Documents()
    write = found.watch(lambda document: document)
    write(catalogue_document())
    assert found.valid == {"jaxgray/effects/1": 1} and not found.faults
    write(catalogue_document() | {"effects": []})
    write({"schema": "jaxgray/other/1"})
    assert len(found.faults) == 2 and "$.effects" in found.faults[0] and "jaxgray/other/1" in found.faults[1]


def test_the_command_prints_them(capsys):
    assert main(["schema"]) == 0
    assert tuple(capsys.readouterr().out.split()) == schemas.names()
    for name in ("diagnosis", "jaxgray/diagnosis/1"):
        assert main(["schema", name]) == 0
        assert json.loads(capsys.readouterr().out) == schemas.schema("jaxgray/diagnosis/1")
    assert main(["schema", "diagnoses"]) == 2
    assert "jaxgray/sweep/1" in capsys.readouterr().err


def test_printing_them_loads_no_jax():
    code = "import sys\nfrom jaxgray.cli import main\nmain(['schema', 'fleet-record'])\nsys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
