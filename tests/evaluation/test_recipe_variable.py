"""Adding a variable: a record in the schema, a function in the evaluation, and the rest follows.

The two are really added, to copies of their modules that every process of a run loads in place of
the originals.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sweep.evaluation import variables
from sweep.evaluation.variables import check_complete
from sweep.experiment.parameters import Stage

TESTS = Path(__file__).parents[1]
TOP = TESTS.parent

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

RECORD = """
    Variable("range_error", _E, "f4", "estimated over true distance of the camera, minus 1",
             present_when=_POSE),
"""
FUNCTION = """
    "range_error": lambda results: (
        np.linalg.norm(results.estimates.translation, axis=1)
        / np.linalg.norm(results.estimates.translation - results.error.translation_m, axis=1) - 1
    ),
"""

ADDITIONS = {
    # Module -> where its text is changed, and what is put there.
    "sweep.experiment.schema": (')\n"""Every variable, in the order', RECORD),
    "sweep.evaluation.variables": (
        '}\n"""Variable of the estimation -> its values (n, ...) for', FUNCTION),
}

# Python imports this in every process that has its folder on PYTHONPATH.
FINDER = """
import importlib.abc, importlib.util, os, sys
from pathlib import Path

class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        file = Path(__file__).parent / f"{name}.txt"
        if name.startswith("sweep.") and file.exists():
            loader = importlib.machinery.SourceFileLoader(name, str(file))
            return importlib.util.spec_from_file_location(name, file, loader=loader)

sys.meta_path.insert(0, Finder())
"""

SCRIPT = """
import sys
import numpy as np
import sweep
from support.here import calls_here
from sweep.cli import main
from sweep.report.reference import TABLES

with calls_here():
    pipeline, new = sys.argv[1:]
    results = sweep.run(pipeline, store=new)
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
    assert main(["verify", new]) == 0
    assert main(["status", new]) == 0
    assert ["range_error", "estimation"] in [row[:2] for row in TABLES["variables"]().rows]
"""


@pytest.mark.long
def test_a_record_and_a_function_make_a_variable(tmp_path):
    overlay = tmp_path / "overlay"
    overlay.mkdir()
    (overlay / "sitecustomize.py").write_text(FINDER)
    for module, (mark, addition) in ADDITIONS.items():
        text = TOP.joinpath(*module.split(".")).with_suffix(".py").read_text()
        assert text.count(mark) == 1, module
        changed = text.replace(mark, addition + (mark if mark not in addition else ""))
        (overlay / f"{module}.txt").write_text(changed)
    pipeline = tmp_path / "range.toml"
    pipeline.write_text(PIPELINE)
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py"), str(pipeline), str(tmp_path / "new.zarr")],
        cwd=TOP,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(overlay), str(TOP), str(TESTS)])},
        capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_variable_without_a_function_and_a_function_without_a_variable_are_refused():
    tables = {Stage.scene: variables.SCENE, Stage.detection: variables.DETECTION}
    check_complete(tables)
    lacking = {name: f for name, f in variables.SCENE.items() if name != "bound"}
    with pytest.raises(TypeError, match="variable bound of stage scene: no function computes it"):
        check_complete({Stage.scene: lacking})
    with pytest.raises(TypeError, match="variable glare of stage detection: the schema lacks it"):
        check_complete({Stage.detection: variables.DETECTION | {"glare": None}})
