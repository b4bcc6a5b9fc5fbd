"""Values as OpenCV, Python and users spell them, and names that are nearly right."""

import cv2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep.errors import PipelineError, StoreError
from sweep.experiment.parameters import PARAMETERS
from sweep.experiment.photographs import read_board
from sweep.experiment.pipeline import Pipeline, parse_selection
from sweep.measure.detectors import REFINEMENTS
from sweep.measure.estimators import SOLVERS
from sweep.messages import nearest
from sweep.store.lifecycle import open_store

OPENCV = {
    "cornerRefinementMethod": {f"CORNER_REFINE_{name.upper()}": name for name in REFINEMENTS},
    "solver": {f"SOLVEPNP_{name.upper()}": name for name in SOLVERS
               if name not in ("photometric", "photometric_real", "recorded")},
    "dictionary": {name: name for name in dir(cv2.aruco) if name.startswith("DICT_")},
}


@pytest.mark.parametrize("name", OPENCV)
def test_every_name_of_opencv_is_understood_in_any_case_and_with_its_module(name):
    parameter = PARAMETERS[name]
    twins = {choice.casefold(): set() for choice in parameter.choices}
    for choice in parameter.choices:  # OpenCV has DICT_APRILTAG_16h5 and ..._16H5
        twins[choice.casefold()].add(choice)
    for spelled, choice in OPENCV[name].items():
        module = "cv2." if name == "solver" else "cv2.aruco."
        assert hasattr(cv2 if name == "solver" else cv2.aruco, spelled)
        for written in (spelled, spelled.lower(), spelled.title(), module + spelled, choice,
                        choice.upper(), f" {choice} ", f"cv::aruco::{spelled}",
                        choice.removeprefix("DICT_")):
            assert parameter.check(written) in twins[choice.casefold()], written
        assert parameter.check(spelled if name == "dictionary" else choice) == choice


@pytest.mark.parametrize(("written", "value"), [
    ("36h11", "DICT_APRILTAG_36h11"), ("tag36h11", "DICT_APRILTAG_36h11"),
    ("25h9", "DICT_APRILTAG_25h9"), ("Tag16H5", "DICT_APRILTAG_16h5"),
    ("AprilTag-36h10", "DICT_APRILTAG_36h10"), ("DICT_36h11", "DICT_APRILTAG_36h11"),
    ("mip_36h12", "DICT_ARUCO_MIP_36h12"), ("4x4-50", "DICT_4X4_50"), ("hd11", "STAG_HD11"),
    ("standard41h12", "tagStandard41h12"), ("circle21h7", "tagCircle21h7"),
])
def test_a_dictionary_is_understood_by_its_number_where_that_is_one(written, value):
    assert PARAMETERS["dictionary"].check(written) == value
    if value.startswith("DICT"):
        pipeline = Pipeline.from_text("[pose]\nside_px = 40", [f"dictionary={written}"])
        assert pipeline.fixed["dictionary"] == value


@pytest.mark.parametrize(("written", "meant"), [
    ("DICT_4X4", "DICT_4X4_50, DICT_4X4_100, DICT_4X4_250 or DICT_4X4_1000"),
    ("5x5", "DICT_5X5_50, DICT_5X5_100, DICT_5X5_250 or DICT_5X5_1000"),
    ("apriltag", ", ".join(f"DICT_APRILTAG_{name}" for name in ("16h5", "25h9", "36h10"))
     + " or DICT_APRILTAG_36h11"),
    ("tag41h12", "tagStandard41h12"),
])
def test_of_several_dictionaries_the_nearest_are_named(written, meant):
    with pytest.raises(ValueError, match=f"; did you mean {meant}\\?$"):
        PARAMETERS["dictionary"].check(written)
    with pytest.raises(PipelineError, match=f"; did you mean {meant}\\?"):
        Pipeline.from_text("[pose]\nside_px = 40", [f'dictionary=["{written}", "36h11"]'])


@given(st.sampled_from(sorted(PARAMETERS)), st.sampled_from(["camera", "pose", "estimator"]))
def test_a_parameter_in_a_wrong_section_is_told_with_the_right_one(name, section):
    assert f"did you mean {name}?" not in nearest(name, list(PARAMETERS))
    home = PARAMETERS[name].section
    if section != home:
        with pytest.raises(PipelineError, match=f"{name}: unknown key; it belongs under .{home}."):
            Pipeline.from_text(f"[{section}]\n{name} = 1")
        with pytest.raises(PipelineError, match=f"expected {name} or {home}.{name}"):
            Pipeline.from_text("", [f"{section}.{name}=1"])


@pytest.mark.parametrize(("wrong", "right"), [
    ("smok.toml", "smoke.toml"), ("Smoke.TOML", "smoke.toml"), ("smoke", "smoke.toml"),
    ("folder/smoek.toml", "folder/smoke.toml"),
])
def test_of_a_misspelled_file_the_nearest_in_its_folder_is_named(
    wrong, right, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name in ("smoke.toml", "other.toml", "camera.yaml", "board.toml", "folder/smoke.toml"):
        (tmp_path / name).touch()
    with pytest.raises(PipelineError, match=f"; did you mean {right}\\?"):
        Pipeline.from_toml(wrong)
    with pytest.raises(PipelineError, match=r"did you mean board\.toml"):
        read_board("bord.toml")
    with pytest.raises(PipelineError, match=r"did you mean camera\.yaml"):
        Pipeline.from_text('[camera]\ncamera_file = "camra.yaml"')
    (tmp_path / "runs/smoke.zarr").mkdir(parents=True)
    with pytest.raises(StoreError, match=r"did you mean runs/smoke\.zarr"):
        open_store("smok.zarr")


def test_the_canonical_value_is_what_is_kept_and_compared():
    for name, written in (("renderer", "Exact"), ("renderer", "Supersample-4-Jittered"),
                          ("window", "FULL"), ("bound", "Known_Blur"), ("solver", "Photometric")):
        assert PARAMETERS[name].check(written) == written.lower()
    plain = Pipeline.from_text('[pose]\nside_px = 40\n[axes]\nsolver = ["SOLVEPNP_IPPE", "Sqpnp"]')
    assert plain.axes[0].values == ("ippe", "sqpnp")
    assert parse_selection("solver=SOLVEPNP_IPPE", plain) == {"solver": "ippe"}
    with pytest.raises(PipelineError, match="each value once"):
        Pipeline.from_text('[axes]\nsolver = ["ippe", "SOLVEPNP_IPPE"]')
