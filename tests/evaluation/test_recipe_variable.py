"""The recipe "add a variable": a record in the schema, and a function in the evaluation."""

import pytest

from support.recipes import added, printed_by
from sweep.evaluation import variables
from sweep.evaluation.variables import check_complete
from sweep.experiment.parameters import Stage

PIPELINE = """
seed = 5
[marker]
size_m = 0.05
[scene]
background = 255
[pose]
jitter_px = 0.5
[axes]
distance_m = [0.4, 40]
trial = 3
solver = ["ippe", "iterative"]
"""

RECORD = """    Variable("range_error", _E, "f4", "estimated over true distance, minus 1",
             present_when=_POSE),
"""
FUNCTION = """    "range_error": lambda results: (
        np.linalg.norm(results.estimates.translation, axis=1)
        / np.linalg.norm(results.estimates.translation - results.error.translation_m, axis=1) - 1
    ),
"""

SCRIPT = """
import numpy as np
import sweep
from support.here import calls_here
from sweep.cli import main
from sweep.report.reference import TABLES

with calls_here():
    results = sweep.run("range.toml", store="new.zarr")
    solved = results["estimate"].values == 1
    error = results["range_error"]
    assert error.dims == results["nees"].dims and error.dtype == "f4"
    assert (np.isfinite(error.values) == solved).all() and solved.any() and not solved.all()
    assert error.attrs["description"].startswith("estimated over true")
    truth = results["true_tvec_m"]
    estimated = truth + results["translation_error_m"]
    expected = (estimated**2).sum("xyz") ** 0.5 / (truth**2).sum("xyz") ** 0.5 - 1
    expected = expected.transpose(*error.dims).values[solved]
    np.testing.assert_allclose(error.values[solved], expected, atol=1e-6)
    assert main(["verify", "new.zarr"]) == 0
    assert ["range_error", "estimation"] in [row[:2] for row in TABLES["variables"]().rows]
print("true")
"""


@pytest.mark.long
def test_a_record_and_a_function_make_a_variable(tmp_path):
    (tmp_path / "range.toml").write_text(PIPELINE)
    folder = added(
        tmp_path, ("experiment/schema.py", "             flags=Flipped),\n", RECORD),
        ("evaluation/variables.py", '    "flipped": _flipped,\n', FUNCTION),
    )
    assert printed_by(folder, SCRIPT)


def test_a_variable_without_a_function_and_a_function_without_a_variable_are_refused():
    tables = {Stage.scene: variables.SCENE, Stage.detection: variables.DETECTION}
    check_complete(tables)
    lacking = {name: f for name, f in variables.SCENE.items() if name != "bound"}
    with pytest.raises(TypeError, match="variable bound of stage scene: no function computes it"):
        check_complete({Stage.scene: lacking})
    with pytest.raises(TypeError, match="variable glare of stage detection: the schema lacks it"):
        check_complete({Stage.detection: variables.DETECTION | {"glare": None}})
