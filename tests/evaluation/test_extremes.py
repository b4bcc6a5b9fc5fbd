"""At the extremes nothing untold passes as detected or solved, and each regime does as it says.

The regimes are the files of pipelines/extremes; ``python -m tests.benchmarks extremes`` prints
what every solver does there.
"""

import numpy as np
import pytest

from benchmarks.bench_extremes import FILES, broken_promises, measured
from support.lengths import lengths
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

PATHS = {path.stem: path for path in FILES}
MAX_SCENES = 300
SUBPIX = "cornerRefinementMethod=subpix"


def regime(name, *settings):
    """Return what all scenes of a regime gave, checked, with settings as ``--set`` takes them."""
    result = measured(Pipeline.from_toml(PATHS[name], settings))
    assert broken_promises(result) == []
    return result


def along(result, variable, axis):
    """Return a variable's values with one of the axes first, the others flat: (n, ...)."""
    pipeline = result.pipeline
    axes = [a for stage in (Stage.detection, Stage.estimation, Stage.scene)
            for a in pipeline.axes_of(stage)]
    values = result.values[variable].reshape([len(a) for a in axes])
    place = [a.name for a in axes].index(axis)
    return np.moveaxis(values, place, 0).reshape(len(axes[place]), -1)


@lengths(8, MAX_SCENES)
@pytest.mark.parametrize("name", PATHS)
def test_all_that_is_detected_or_solved_is_finite_and_nothing_is_raised_or_printed(name, count):
    assert broken_promises(measured(Pipeline.from_toml(PATHS[name]), count)) == []


FLAGS = [
    ("tilt_grazing", ["bearing_y_deg=0", "tilt_deg=[89.9, 89.99]"], "no_candidate"),
    ("tilt_grazing", ["bearing_y_deg=10", "azimuth_deg=0", "tilt_deg=[85, 89.99]"], "not_visible"),
    ("tilt_grazing", ["bearing_y_deg=-10", "azimuth_deg=0", "tilt_deg=[80, 89.99]", "side_px=150"],
     "detected"),
    ("side_huge", ["side_px=[5000, 1e5, 1e8]", "tilt_deg=0"], "no_candidate"),
    ("side_huge", ["side_px=[5000, 1e5, 1e8]", "tilt_deg=30"], "not_visible"),
    ("corner_behind", ["side_px=400", "tilt_deg=[60, 70, 80]"], "not_visible"),
    ("scale", ["size_m=[0.001, 1000]", "guarded=true"], "detected"),
    ("focal_length", ["fx_px=[1e3, 1e5]", "side_px=80"], "detected"),
    ("principal_point", ["cx_px=-50000", "bearing_x_deg=89.316848753", "tilt_deg=0"], "detected"),
    # Sideways: without its fold at -29 degrees it would be drawn in the frame.
    ("lens_fold", ["distortion=[0, 0, 0.3, 0]", "bearing_x_deg=0", "bearing_y_deg=-35"],
     "not_modelled"),
    ("noise", ["noise_grey=1000", "side_px=60"], "rejected no_candidate"),
    ("saturated", ["gain=[0.01, 10, 1e4]"], "no_candidate"),
    ("inverted", ["detectInvertedMarker=true", "side_px=80", SUBPIX], "detected"),
    ("zero_contrast", [], "no_candidate"),
    ("frame_wide", ["height_px=300", "side_px=280", "bearing_x_deg=[0, 30, 44]"], "detected"),
]
"""Regime, settings, and all the flags that its searches then give."""


@pytest.mark.parametrize(("name", "settings", "expected"), FLAGS, ids=str)
def test_regime_is_flagged_as_expected(name, settings, expected):
    flags = np.unique(regime(name, "solver=ippe_square", *settings).values["detection"])
    assert {DetectionStatus(flag).name for flag in flags} == {*expected.split()}


def test_of_a_pair_on_the_planar_ambiguity_one_is_flipped_and_neither_is_anything_else():
    result = regime("planar_ambiguity", "fx_px=50000", "side_px=[30, 60]", SUBPIX)
    assert (result.values["estimate"] == EstimateStatus.solved).all()
    flipped = along(result, "flipped", "solver") == Flipped.flipped
    assert (np.abs(flipped.mean(axis=1) - 0.5) < 0.15).all()
    both = [result.values[name][:, :2] for name in
            ("rotation_error_deg", "alternative_rotation_error_deg")]
    assert np.fmin(*both).max() < 10.0
    near = regime("planar_ambiguity", "fx_px=500", "side_px=60", "tilt_deg=[20, 50]", SUBPIX)
    assert (near.values["flipped"] == Flipped.not_flipped).all()


def test_corners_outside_the_image_of_the_believed_lens_are_not_solved():
    for bearing, expected in (("[0, 5, 10, 15]", {EstimateStatus.solved}),
                              ("[22, 25]", {EstimateStatus.solver_failed})):
        result = regime("lens_believed", f"bearing_x_deg={bearing}", SUBPIX)
        assert {*np.unique(result.values["estimate"])} == expected
