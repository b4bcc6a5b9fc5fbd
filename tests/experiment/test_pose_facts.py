"""What may surprise of poses is told in a line, by `plan` and at the start of a run."""


import pytest

from sweep.experiment.experiment import MAX_SAMPLE
from sweep.experiment.pipeline import Pipeline


def told(pose, axes=None, **sections):
    return Pipeline.from_dict({"pose": pose, "axes": axes or {}, **sections}).facts.notes


@pytest.mark.parametrize(("pose", "axes", "named"), [
    ({"distance_m": 0.3}, {"tilt_deg": [0, 45, 80], "bearing_x_deg": [0, 4.9]}, []),
    ({"distance_m": 0.3}, {"tilt_deg": [0, 120]}, ["50 % of the poses show the marker's back"]),
    ({"distance_m": 0.3, "view_angle_deg": 0}, {"bearing_x_deg": [0, 35]},
     ["50 % of the poses are outside the frame: not_visible; frame_x and frame_y"]),
    ({"distance_m": 0.3, "view_angle_deg": 0, "y_m": 0.134}, {"trial": 1},
     ["all poses are cut off by the frame's edge"]),
    ({"camera_z_m": 1, "marker_yaw_deg": 180}, {"marker_x_m": [-2, -1]},
     ["all poses have a corner behind the camera: not_visible"]),
    ({"camera_z_m": 1}, {"marker_x_m": [0.5], "marker_yaw_deg": [0, 180]},
     ["50 % of the poses show the marker's back",
      "50 % of the poses are outside the frame: not_visible"]),
])
def test_what_may_surprise_of_poses_is_a_line_each(pose, axes, named):
    lines = told(pose, axes)
    assert len(lines) == len(named), lines
    for line, part in zip(lines, named, strict=True):
        assert part in line


def test_poses_where_the_lens_folds_are_told():
    # r(1 - 0.3 r²) grows up to r = 1/sqrt(0.9): tan 46.5°.
    line = told({"distance_m": 1.0}, {"bearing_x_deg": [0, 50]}, marker={"size_m": 0.1}, camera={
        "fx_px": 300, "distortion": [-0.3, 0, 0, 0]})[0]
    assert line.startswith("50 % of the poses lie where the lens folds")


def test_poses_of_a_large_grid_are_a_sample_with_its_corners():
    pipeline = Pipeline.from_dict({
        "pose": {"bearing_x_deg": {"uniform": [-40, 40]}},
        "axes": {"tilt_deg": {"linspace": [0, 60, 61]}, "distance_m": {"geom": [0.1, 10, 1000]},
                 "trial": 1000},
    })
    facts = pipeline.facts
    assert f"({MAX_SAMPLE} poses looked at)" in facts.pose_line
    assert facts.view_ranges["tilt_deg"] == pytest.approx([0, 60], abs=1e-12)
    least, largest = facts.view_ranges["range_m"]
    assert least < 0.2
    assert 10 <= largest < 14
    # tan 30.96° = 320 / 533.3 is the frame's edge: 9/40 of the bearings are outside: a share
    # of 600 poses is off by 0.11, six standard deviations, with a probability of 1e-9.
    line, = (line for line in facts.notes if "outside the frame" in line)
    assert abs(float(line.split()[1]) / 100 - (1 - 30.96 / 40)) < 0.11


@pytest.mark.parametrize(("document", "name", "reason"), [
    ({}, "full frame", None),
    ({}, "window", "px around the marker's pixels"),
    ({"detector": {"useAruco3Detection": True}}, "full frame",
     "useAruco3Detection scales the image by the frame's size"),
    ({"scene": {"blur_px": 0.5}}, "optical blur", "blur_px is 0.5"),
    ({"scene": {"noise_grey": {"uniform": [1, 2]}}}, "random draws", "noise_grey"),
    ({"camera": {"distortion": [0.1, 0, 0, 0]}}, "lens distortion", "distortion is given"),
    ({"estimator": {"solver": "photometric"}}, "pixels kept", "solver photometric needs them"),
    ({"estimator": {"believed_focal_scale": 1.01}}, "wrong assumptions", "believed_focal_scale"),
])
def test_parts_are_active_for_a_reason(document, name, reason):
    pipeline = Pipeline.from_dict({"pose": {"side_px": 40}, **document})
    part, = (each for each in pipeline.facts.parts if each.name == name)
    assert part.active == (reason is not None)
    assert (reason or "no setting needs it") in part.reason
