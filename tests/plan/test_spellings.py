"""Values as OpenCV, Python and users spell them, and names that are nearly right."""

import cv2
import pytest

from sweep.errors import PipelineError
from sweep.measure.detector import REFINEMENTS
from sweep.measure.estimators import SOLVERS
from sweep.plan.cell_selection import parse_selection
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import PARAMETERS

OPENCV = {
    "cornerRefinementMethod": {f"CORNER_REFINE_{name.upper()}": name for name in REFINEMENTS},
    "solver": {f"SOLVEPNP_{name.upper()}": name for name in SOLVERS
               if name not in ("photometric", "photometric_real", "recorded")},
    "dictionary": {name: name for name in dir(cv2.aruco) if name.startswith("DICT_")},
}


@pytest.mark.parametrize("name", OPENCV)
def test_every_name_of_opencv_is_understood_in_any_case_and_with_its_module(name):
    parameter = PARAMETERS[name]
    twins = {choice.casefold(): set() for choice in parameter.declaration.choices}
    for choice in parameter.declaration.choices:  # OpenCV has DICT_APRILTAG_16h5 and ..._16H5
        twins[choice.casefold()].add(choice)
    for spelled, choice in OPENCV[name].items():
        module = "cv2." if name == "solver" else "cv2.aruco."
        assert hasattr(cv2 if name == "solver" else cv2.aruco, spelled)
        for written in (spelled, spelled.lower(), spelled.title(), module + spelled, choice,
                        choice.upper(), f" {choice} ", f"cv::aruco::{spelled}",
                        choice.removeprefix("DICT_")):
            assert parameter.check(written) in twins[choice.casefold()], written
        assert parameter.check(spelled if name == "dictionary" else choice) == choice


@pytest.mark.parametrize(
    ("name", "written", "value"),
    [
        ("renderer", "Exact", "exact"), ("renderer", "Supersample-4-Jittered",
                                         "supersample-4-jittered"),
        ("window", "FULL", "full"), ("bound", "Known_Blur", "known_blur"),
        ("solver", "Photometric", "photometric"),
    ],
)
def test_every_choice_is_understood_in_any_case(name, written, value):
    assert PARAMETERS[name].check(written) == value


def test_the_canonical_value_is_what_is_kept_and_compared():
    rest = "[pose]\nside_px = 40\n[marker]\nsize_m = 0.1"
    plain = Pipeline.from_text(f'[axes]\nsolver = ["ippe", "sqpnp"]\n{rest}')
    other = Pipeline.from_text(
        f'[axes]\nsolver = ["SOLVEPNP_IPPE", "Sqpnp"]\n{rest}\ndictionary = "dict_5x5_50"')
    assert other.axes == plain.axes
    assert dict(other.fixed) == dict(plain.fixed)
    assert parse_selection("solver=SOLVEPNP_IPPE") == {"solver": "ippe"}
    with pytest.raises(PipelineError, match="each value once"):
        Pipeline.from_text('[axes]\nsolver = ["ippe", "SOLVEPNP_IPPE"]')
    set_so = Pipeline.from_text(
        "[pose]\nside_px = 40", ["solver=SOLVEPNP_IPPE", "guarded=False"])
    assert (set_so.fixed["solver"], set_so.fixed["guarded"]) == ("ippe", False)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[detector]\ncornerRefinementMethod = 1", "OpenCV's constant 1 is subpix"),
        ("[axes]\ncornerRefinementMethod = [0, 1]", "OpenCV's constant 0 is none"),
        (f"[estimator]\nsolver = {cv2.SOLVEPNP_IPPE_SQUARE}", "is ippe_square"),
        ("[marker]\ndictionary = 4", "OpenCV's constant 4 is DICT_5X5_50"),
        ("[detector]\ncornerRefinementMethod = 99", "expected one of none, subpix"),
        ("[estimator]\nsolver = true", "expected one of ippe"),
        ('[estimator]\nsolver = "ippe_sqare"', "did you mean ippe_square?"),
        ('[marker]\ndictionary = "DICT_5X5_51"', "did you mean DICT_5X5_50?"),
        ("[pose]\nTilt_Deg = 3", "did you mean tilt_deg?"),
        ("[marker]\nmarkerid = 3", "did you mean marker_id?"),
        ("[marker]\nMARKER-ID = 3", "did you mean marker_id?"),
        ("[detector]\ncorner_refinement_method = 'subpix'", "did you mean cornerRefinementMethod?"),
        ("[axes]\nTrials = 3", "did you mean trial?"),
        ("[Pose]\ntilt_deg = 3", "did you mean pose?"),
        ("Seed = 3", "did you mean seed?"),
    ],
)
def test_what_is_nearly_right_is_told_with_what_is_right(text, told):
    with pytest.raises(PipelineError) as raised:
        Pipeline.from_text(text)
    lines = [line for line in raised.value.faults if "expected distance_m or side_px" not in line]
    assert len(lines) == 1
    assert told in lines[0]


@pytest.mark.parametrize(
    ("setting", "told"),
    [("Tilt_Deg=3", "did you mean tilt_deg?"), ("markerid=3", "did you mean marker_id?"),
     ("pose.TiltDeg=3", "did you mean tilt_deg?")],
)
def test_what_is_nearly_right_is_told_of_settings(setting, told):
    with pytest.raises(PipelineError, match=told.replace("?", "\\?")):
        Pipeline.from_text("", [setting])
