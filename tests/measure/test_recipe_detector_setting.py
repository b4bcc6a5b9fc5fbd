"""The recipe "add a detector setting": one is taken away and added again, as the recipe says."""

import dataclasses
import inspect
import re

import pytest

from sweep.measure.detectors import DetectorSetting
from tests.support.recipes import added, printed_by

NAME = "minOtsuStdDev"

SCRIPT = """
import json
from sweep.errors import PipelineError
from sweep.evaluation.block import run_cells
from sweep.experiment.pipeline import Pipeline
from sweep.report.reference import TABLES

def read(values):
    try:
        return Pipeline.from_dict({
            "marker": {"size_m": 0.05}, "pose": {"distance_m": 0.5},
            "scene": {"black": 100, "white": 130, "background": 130},
            "axes": {"minOtsuStdDev": values},
        }), ""
    except PipelineError as error:
        return None, str(error)

pipeline, message = read([40.0, 5.0])
detection = [] if pipeline is None else [
    column.tolist() for column in run_cells(pipeline.experiment, []).columns["detection"]
]
rows = [row[:4] for row in TABLES["detector"]().rows]
print(json.dumps([message, read([-1.0])[1], detection, rows]))
"""


@pytest.mark.long
def test_setting_is_one_field(tmp_path):
    source = inspect.getsource(DetectorSetting)
    field = re.search(rf"    {NAME}: float = parameter\(.*?\n    \)\n", source, re.DOTALL)[0]
    without = added(tmp_path / "without")
    file = without / "sweep" / "measure" / "detectors.py"
    file.write_text(file.read_text().replace(field, ""))
    message, _, _, rows = printed_by(without, SCRIPT)
    assert f"axes.{NAME}" in message
    assert NAME not in [row[0] for row in rows]

    # Put back as a contributor would: as the last of the fields.
    last = [each.name for each in dataclasses.fields(DetectorSetting)][-1]
    line = re.search(rf"    {last}: .*?\n    \)\n", source, re.DOTALL)[0]
    file.write_text(file.read_text().replace(line, line + field))
    message, out_of_range, detection, rows = printed_by(without, SCRIPT)
    assert message == ""
    assert f"{NAME} = -1" in out_of_range.replace("[", "").replace("axes.", "")
    assert [NAME, "5", "grey level", "a number at least 0"] in rows
    # Levels 30 apart have a standard deviation of at most 15: below 40 they count as one colour.
    (strict,), (lax,) = detection
    assert (strict != 1, lax) == (True, 1)
