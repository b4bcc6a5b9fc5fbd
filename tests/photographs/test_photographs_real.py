"""Sets of public photographs, where the environment variable SWEEP_PHOTOS names their folder."""

import os
from pathlib import Path

import numpy as np
import pytest

import sweep
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

FOLDER = os.environ.get("SWEEP_PHOTOS", "")

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not Path(FOLDER, "charuco_480").is_dir(),
        reason="SWEEP_PHOTOS does not name the folder of the sets of photographs",
    ),
]

CHARUCO = (
    'kind = "charuco"\ndictionary = "DICT_4X4_1000"\nsquares_x = 8\nsquares_y = 8\n'
    "square_m = 0.0254\n"
)
REFINEMENTS = ["none", "subpix", "contour", "apriltag"]

PUBLISHED = {
    # Median rotation error in degrees, flips, median range error in percent: measured before by
    # others, whose truth was another fit to the board. An eighth of the flips, and of the medians
    # a tenth, lie within the intervals by photograph.
    "charuco_480": (
        CHARUCO + "marker_m = 0.01905\n",
        {"none": (6.5, 175, 3.9), "subpix": (5.2, 158, 2.2), "contour": (4.6, 154, 5.0),
         "apriltag": (3.6, 126, 0.1)},
    ),
    "charuco_1280_legacy": (
        CHARUCO + "marker_m = 0.019\nlegacy_pattern = true\n",
        {"none": (4.3, 109, 2.0), "subpix": (1.5, 20, 1.2), "contour": (1.6, 41, 2.9),
         "apriltag": (1.8, 52, 0.8)},
    ),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_opencvs_errors_are_those_that_were_published(name, tmp_path):
    text, published = PUBLISHED[name]
    board = tmp_path / "board.toml"
    board.write_text(text)
    results = sweep.photos(
        Path(FOLDER, name), camera="calibrate", board=board, store=tmp_path / f"{name}.zarr",
        settings=[f"cornerRefinementMethod={REFINEMENTS}".replace("'", '"')],
    ).load()
    for refinement, (rotation_deg, flips, range_percent) in published.items():
        each = results.sel(cornerRefinementMethod=refinement)
        solved = (each.estimate == EstimateStatus.solved).values
        turned = each.rotation_error_deg.values[solved]
        error = (each.translation_error_m / each.true_tvec_m).values[..., 2][solved] * 100
        found = int((each.flipped.values == Flipped.flipped).sum())
        shown = int((each.detection != DetectionStatus.not_in_photograph).sum())
        print(name, refinement, shown, np.median(turned), found, np.median(error))
        assert np.median(turned) == pytest.approx(rotation_deg, rel=0.1)
        assert found == pytest.approx(flips, rel=0.125)
        assert np.median(error) == pytest.approx(range_percent, abs=0.15)
