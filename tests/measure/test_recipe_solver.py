"""The recipe "add a solver": one is added in the one place that the recipe names."""

import numpy as np
import pytest

from tests.support.recipes import added, printed_by

SOLVER = """
from dataclasses import dataclass

import numpy as np

from sweep.measure.estimation import Estimates
from sweep.measure.flags import EstimateStatus


@dataclass(frozen=True, slots=True)
class FrontalSolver:
    needs_images = True

    def __call__(self, detections):
        estimates = Estimates.none(len(detections.corners), EstimateStatus.solved)
        side = np.linalg.norm(
            np.roll(detections.corners, -1, axis=1) - detections.corners, axis=2
        ).mean(axis=1)
        view = detections.cameras.view
        depth = view[:, 0] * detections.size_m / side
        centre = (detections.corners.mean(axis=1) - view[:, 2:]) / view[:, :2]
        estimates.rotation[:] = np.diag([1.0, -1.0, -1.0])
        estimates.translation[:, :2] = centre * depth[:, None]
        estimates.translation[:, 2] = depth
        estimates.reprojection_px[:] = [image.mean() for image in detections.images]
        return estimates
"""
"""A frontal pose at the depth of the corners' mean side; it reports the image's mean, too."""

RECORD = """
    "frontal": Solver("a frontal pose", lambda setting: FrontalSolver(), needs_images=True),
"""

SCRIPT = """
import json
import numpy as np
from sweep.errors import PipelineError
from sweep.evaluation.block import run_cells
from sweep.experiment.pipeline import Pipeline
from sweep.report.reference import TABLES

def read(solver):
    return Pipeline.from_dict({
        "marker": {"size_m": 0.05}, "pose": {"distance_m": 0.5, "bearing_x_deg": 4},
        "axes": {"solver": [solver, "ippe_square"], "roll_deg": [0, 90]},
    })

pipeline = read("frontal")
columns = run_cells(pipeline.experiment, [np.arange(2)]).columns
try:
    read("frontale")
except PipelineError as error:
    message = str(error)
print(json.dumps({
    "estimate": [column.tolist() for column in columns["estimate"]],
    "position": columns["translation_error_m"][0].tolist(),
    "rotation": [column.tolist() for column in columns["rotation_error_deg"]],
    "grey": columns["reprojection_error_px"][0].tolist(),
    "message": message,
    "table": TABLES["solvers"]().rows, "parameters": TABLES["estimator"]().markdown(),
}))
"""


@pytest.mark.system
def test_solver_is_one_class_and_one_record(tmp_path):
    file = "measure/estimators.py"
    folder = added(
        tmp_path,
        ("measure/frontal.py", None, SOLVER),
        (file, "    PoseEstimator,\n    credible_estimates,\n)\n",
         "from sweep.measure.frontal import FrontalSolver\n"),
        (file, "SOLVERS: dict[str, Solver] = {", RECORD),
    )
    result = printed_by(folder, SCRIPT)
    assert result["estimate"] == [[1, 1], [1, 1]]
    np.testing.assert_allclose(result["position"], 0, atol=1e-2)
    np.testing.assert_allclose(result["rotation"][0], [0, 90], atol=1e-4)
    assert max(result["rotation"][1]) < 15
    assert all(0 < grey < 255 for grey in result["grey"])
    assert "one of frontal, ippe" in result["message"]
    assert ["frontal", "a frontal pose", "pixels", "no"] in result["table"]
    assert "frontal: a frontal pose" in result["parameters"]
