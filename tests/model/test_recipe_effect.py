"""The recipe "add an effect": two are added, one a step, in the one place that the recipe names."""

import numpy as np
import pytest

from support.recipes import added, printed_by

RECORDS = """
    Effect(
        "haze", "light",
        {"haze": parameter(0.0, "share of the light that haze adds", low=0, high=1, drawable=True)},
        apply=lambda light, patch: light * (1 - patch.values["haze"]) + 200 * patch.values["haze"],
    ),
    Effect(
        "column noise", "signal",
        {
            "column_noise_grey": parameter(0.0, "noise of columns", low=0, high=100),
            "column_period_px": parameter(2.0, "their period", low=1, high=100),
        },
        needs={"column_period_px": ("column_noise_grey",)}, random=True, widens="noise",
        apply=lambda signal, patch: signal + patch.values["column_noise_grey"] * (
            (patch.left + np.arange(signal.shape[1])) % patch.values["column_period_px"] == 0
        ) * patch.normals("column_noise_grey", signal.shape),
    ),
"""

SCRIPT = """
import json
import numpy as np
from sweep.errors import PipelineError
from sweep.evaluation.block import run_cells
from sweep.evaluation.search import detections_of, scenes_at, search_windows
from sweep.measure.flags import BoundStatus
from sweep.model.renderers import marker_levels
from sweep.experiment.pipeline import Pipeline
from sweep.report.reference import TABLES

def read(**scene):
    return Pipeline.from_dict({
        "camera": {"width_px": 160, "height_px": 120}, "marker": {"size_m": 0.05},
        "pose": {"distance_m": 0.3, "tilt_deg": 20},
        "scene": {"background": 90, "black": 20, "white": 230, "bound": "known_blur"} | scene,
        "axes": {"haze": [0, 0.25], "column_noise_grey": [0, 6], "window": ["auto", "full"]},
    })

def broken(**scene):
    try:
        read(**scene)
    except PipelineError as error:
        return str(error)

pipeline = read(column_period_px=3)
indices = [index.ravel() for index in np.indices((2, 2, 2))]
batch = scenes_at(pipeline.experiment, indices)
scenes, boxes, settings = batch.scenes, batch.boxes, pipeline.experiment.detectors
(result,), _ = detections_of(batch, np.ones((8, 1), dtype=bool), [], keep=True)
box = tuple(boxes[0].tolist())
mean, share = marker_levels(scenes, 0, box)
cells = run_cells(pipeline.experiment, indices)
print(json.dumps({
    "box": box, "levels": (mean + (1 - share) * 90).tolist(),
    "images": [result.images[row].tolist() for row in range(8)],
    "origins": result.origins.tolist(),
    "windows": search_windows(scenes, boxes, settings[0], np.zeros(8, dtype=bool)).tolist(),
    "bound": [BoundStatus(int(flag)).name for flag in cells.columns["bound"][0]],
    "broken": [broken(haze_x=1), broken(read_noise_e=3)],
    "table": TABLES["effects"]().rows, "parameters": TABLES["scene"]().markdown(),
}))
"""


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    file = "model/effects.py"
    changes = (
        (file, "import dataclasses\n", "import numpy as np\n"),
        (file, "EFFECTS: tuple[Effect, ...] = (", RECORDS),
    )
    return printed_by(added(tmp_path_factory.mktemp("recipe"), *changes), SCRIPT)


@pytest.mark.long
def test_pixels_are_those_of_plain_numpy(result):
    x0, y0, x1, y1 = result["box"]
    frame = np.full((120, 160), 90.0)
    frame[y0:y1, x0:x1] = result["levels"]
    hazy = frame * (1 - 0.25) + 200 * 0.25
    for row, expected in ((0, frame), (1, frame), (4, hazy), (5, hazy)):
        image, (left, top) = np.array(result["images"][row]), result["origins"][row]
        height, width = image.shape
        whole = np.clip(np.floor(expected + 0.5 + 1e-9), 0, 255)
        np.testing.assert_array_equal(image, whole[top : top + height, left : left + width])


def test_all_else_follows_from_the_record(result):
    # Neither is part of the bound's model; without them there is no noise.
    assert result["bound"] == ["no_noise"] * 2 + ["not_in_model"] * 6
    quiet, noisy = np.array(result["windows"][0]), np.array(result["windows"][2])
    assert (noisy[:2] <= quiet[:2]).all()
    assert (noisy[2:] >= quiet[2:]).all()
    assert (noisy != quiet).any()
    assert "did you mean haze?" in result["broken"][0]
    assert "expected full_well_e beside it" in result["broken"][1]
    rows = [row[:6] for row in result["table"]]
    assert ["haze", "haze", "0", "light", "no", "no"] in rows
    assert ["column noise", "column_noise_grey", "0", "signal", "yes", "no"] in rows
    assert "column\\_period\\_px" in result["parameters"]
