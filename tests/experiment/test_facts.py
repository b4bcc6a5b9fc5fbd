"""What is told of a pipeline: surprises of poses, settings in use, and short names."""

from __future__ import annotations

import itertools
import zlib

import pytest

from sweep.declaration import declared_fields
from sweep.experiment.experiment import MAX_SAMPLE, distinct, used_settings
from sweep.experiment.parameters import PARAMETERS, SECTIONS
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, short_name
from sweep.store.files import RECEIPTS
from sweep.store.lifecycle import planned_arrays


@pytest.mark.parametrize(("pose", "axes", "named"), [
    ({"distance_m": 0.3}, {"tilt_deg": [0, 45, 80], "bearing_x_deg": [0, 4.9]}, []),
    ({"distance_m": 0.3}, {"tilt_deg": [0, 120]}, ["50 % of the poses show the marker's back"]),
    ({"distance_m": 0.3, "view_angle_deg": 0}, {"bearing_x_deg": [0, 35]},
     ["50 % of the poses are outside the frame: not_visible; frame_x and frame_y"]),
    ({"distance_m": 0.3, "view_angle_deg": 0, "y_m": 0.134}, {"trial": 1},
     ["all poses are cut off by the frame's edge"]),
    ({"camera_z_m": 1, "marker_yaw_deg": 180}, {"marker_x_m": [-2, -1]},
     ["all poses have a corner behind the camera: not_visible"]),
    # r(1 - 0.3 r²) grows up to r = 1/sqrt(0.9): tan 46.5°.
    ({"distance_m": 1}, {"bearing_x_deg": [0, 50], "size_m": [0.1], "fx_px": [300],
                         "distortion": [[-0.3, 0, 0, 0]]},
     ["50 % of the poses lie where the lens folds"]),
    ({"camera_z_m": 1}, {"marker_x_m": [0.5], "marker_yaw_deg": [0, 180]},
     ["50 % of the poses show the marker's back",
      "50 % of the poses are outside the frame: not_visible"]),
])
def test_what_may_surprise_of_poses_is_a_line_each(pose, axes, named):
    lines = Pipeline.from_dict({"pose": pose, "axes": axes}).facts.notes
    assert len(lines) == len(named), lines
    for line, part in zip(lines, named, strict=True):
        assert part in line


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


PLUGINS = """
from dataclasses import dataclass
from sweep.plugins import DetectorPlugin, EstimatorPlugin, parameter

@dataclass(frozen=True)
class Fine:
    steps: int = parameter(2, "steps", low=1)

A = DetectorPlugin(make=lambda settings, family: lambda image: ([], []), settings=Fine)
B = DetectorPlugin(make=lambda settings, family: lambda image: ([], []))
S = EstimatorPlugin(make=lambda settings: lambda detections: None)
"""

TEXT = """
[pose]
side_px = 40
[axes]
cornerRefinementMethod = ["none", "subpix"]
steps = [2, 3]
detector = ["opencv", "own.py:A", "own.py:B"]
solver = ["ippe", "own.py:S"]
guarded = [true, false]
"""


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    folder = tmp_path_factory.mktemp("settings")
    (folder / "own.py").write_text(PLUGINS)
    return lambda text: Pipeline.from_text(text, folder=folder)


def combinations(pipeline):
    return [dict(zip([axis.name for axis in pipeline.axes], chosen, strict=True))
            for chosen in itertools.product(*(axis.values for axis in pipeline.axes))]


def test_each_detector_and_solver_is_told_apart_by_its_own_settings_alone(pipeline):
    made = pipeline(TEXT)
    every = combinations(made)
    texts = [" ".join(map(str, used_settings(made, every[k]).values()))
             for k in distinct(made, every)]
    detectors = ["none opencv", "subpix opencv", "2 own.py:A", "3 own.py:A", "own.py:B"]
    solvers = ["ippe True", "ippe False", "own.py:S"]
    assert sorted(texts) == sorted(map(" ".join, itertools.product(detectors, solvers)))


def test_settings_of_a_fixed_detector_and_those_that_go_together(pipeline):
    fixed = pipeline('[pose]\nside_px = 40\n[detector]\ndetector = "own.py:B"\n[axes]\n'
                     "adaptiveThreshConstant = [5, 7]\n")
    assert used_settings(fixed, {"adaptiveThreshConstant": 5}) == {}
    assert distinct(fixed, combinations(fixed)) == [0]
    together = pipeline(
        '[pose]\nside_px = 40\n[axes]\npair = { zip = { detector = ["opencv", "own.py:A"], '
        "steps = [2, 3] } }\n")
    assert len(distinct(together, combinations(together))) == 2


MAX_LINE = 30
"""Characters after which xarray breaks a label; three lines fit beside a chart."""

EVERYTHING = {
    "pose": {"side_px": {"uniform": [20, 40]}, "jitter_px": 0.5, "azimuth_deg": {
        "uniform": [0, 360]}},
    "scene": {"noise_grey": 2, "bound": "known_blur"},
    "axes": {"tilt_deg": [0, 30], "cornerRefinementMethod": ["none", "subpix"],
             "adaptiveThreshWinSizeMax": [13, 23], "trial": 2},
}


def test_every_array_of_a_store_has_a_short_name_and_its_meaning():
    pipeline = Pipeline.from_dict(EVERYTHING)
    for array in planned_arrays(pipeline, (1, 2)):
        if array.path != RECEIPTS and array.attributes:
            assert len(array.attributes["long_name"]) <= MAX_LINE + 2, array.path
            assert array.attributes["description"], array.path


def test_names_of_variables_and_parameters_are_short_and_distinct():
    names = {variable.name: variable.units for variable in SCHEMA} | {
        name: parameter.unit for name, parameter in PARAMETERS.items()}
    short = {name: short_name(name, units) for name, units in names.items()}
    assert max(map(len, short.values())) <= 40
    labels = [f"{short[name]} [{units}]" for name, units in names.items()]
    assert len(set(labels)) == len(labels)
    declared = [name for groups, _ in SECTIONS.values() for each in groups
                for name in declared_fields(each)]
    assert len(declared) == len(PARAMETERS)


def test_defaults_ranges_and_flags_are_those_that_were_recorded():
    declared = [(p.section, name, p.default, p.low, p.high) for name, p in PARAMETERS.items()]
    declared += [(v.name, flag.name, int(flag)) for v in SCHEMA for flag in v.flags or ()]
    assert zlib.crc32(repr(declared).encode()) == 2953779163, "old stores would mean another thing"
