"""Results as tables of pandas, and what is said without it."""

import dataclasses
import sys

import numpy as np
import pandas
import pytest
from independent import REFERENCE_TIME, reference_record
from made_diagnosis import diagnosis, equivalent, nothing

import jaxgray
from jaxgray import Record
from jaxgray.diagnosis.findings import Estimate
from jaxgray.identification.refinement.uncertainty import entry_names

UNITS = {"input_units": ("N", "N"), "output_units": ("m", "m")}


def record(seed):
    u, y, _ = reference_record(seed, samples=3000)
    return Record(u, y, REFERENCE_TIME, **UNITS)


@pytest.fixture(scope="module")
def identified():
    return jaxgray.identify(record(1))


def test_parameters_of_an_identification(identified):
    table = identified.to_dataframe()
    assert tuple(table.index) == entry_names(2) and list(table.columns) == ["value", "standard_error", "unit"]
    assert table.loc["stiffness[0,1]", "value"] == identified.stiffness[0, 1]
    np.testing.assert_array_equal(table["standard_error"], np.sqrt(np.diag(identified.covariance)))
    assert table.loc["damping[1,1]", "unit"] == "N s/m"
    assert "<table" in identified._repr_html_()


def test_without_refinement_errors_are_not_numbers():
    table = jaxgray.identify(record(1), refine=False).to_dataframe()
    assert table["standard_error"].isna().all() and table["value"].notna().all()


def test_the_grid_of_a_sweep():
    found = jaxgray.sweep(record(1), validation=record(2), time_constants=[0.05, 0.1, 0.2], block_rows=[4, 6])
    table = found.to_dataframe()
    assert len(table) == 6 and table["block_rows"].tolist() == [4, 6] * 3
    best = table.iloc[np.ravel_multi_index(found.best_index, (3, 2))]
    assert best["time_constant"] == found.best["time_constant"]
    assert best["mass[0,1]"] == found.best["mass"][0, 1]
    assert best["fit_percent_y2_validation"] == found.best["validation_fit_percent"][1]
    assert "<table" in found._repr_html_()


def test_records_of_a_batch():
    found = jaxgray.identify_many([record(1), record(3)], alone=False)
    table = found.to_dataframe()
    assert len(table) == 2 and table["successful"].tolist() == found.successful.tolist()
    assert table.loc[1, "mass[0,0]"] == found.mass[1, 0, 0]
    assert table.loc[1, "stiffness[0,1]_error"] == found.standard_errors["stiffness"][1, 0, 1]
    assert table.loc[0, "rmse_y2"] == found.rmse[0, 1]


def test_findings_of_a_diagnosis():
    found = diagnosis()
    table = found.to_dataframe()
    (finding,) = found.findings
    assert table["parameter"].tolist() == list(finding.parameters) and set(table["finding"]) == {0}
    force = table[table["parameter"] == "Fc"].iloc[0]
    assert (force["value"], force["standard_error"], force["unit"]) == (0.2412, 0.0023, "N")
    assert (force["effect"], force["location"], force["status"]) == ("coulomb_friction", "y1", "named")
    assert (force["gain_percent"], force["ci95_lower"], force["held_out"]) == (64.2, 61.1, True)
    # What was held fixed has no error.
    assert table[table["parameter"] == "eps"]["standard_error"].isna().all()
    assert table["value"].dtype == float and found._repr_html_()


def test_look_alikes_have_rows_of_their_own():
    found = equivalent()
    table = found.to_dataframe()
    for k, member in enumerate(found.findings[0].members):
        rows = table[table["member"] == k]
        assert set(rows["effect"]) == {member.effect} and rows["parameter"].tolist() == list(member.parameters)


def test_lists_and_findings_without_parameters():
    (friction,) = diagnosis().findings
    listed = {"a": Estimate((1.0, 2.0), (0.1, None), "N"), "b": Estimate((3.0,), None, "")}
    findings = dataclasses.replace(friction, parameters=listed), dataclasses.replace(friction, parameters={}, gain=None)
    table = diagnosis(findings=findings).to_dataframe()
    assert table["parameter"].tolist()[:3] == ["a[0]", "a[1]", "b[0]"] and table["value"].tolist()[:3] == [
        1.0,
        2.0,
        3.0,
    ]
    assert table["standard_error"].tolist()[0] == 0.1 and table["standard_error"].isna().tolist()[1:] == [True] * 3
    assert table["finding"].tolist() == [0, 0, 0, 1] and table.iloc[3][["value", "gain_percent"]].isna().all()


def test_nothing_found_is_an_empty_table_with_its_columns():
    table = nothing().to_dataframe()
    assert isinstance(table, pandas.DataFrame) and len(table) == 0 and "standard_error" in table


def test_without_pandas_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"^to_dataframe needs pandas: pip install 'jaxgray\[pandas\]'\.$"):
        diagnosis().to_dataframe()
