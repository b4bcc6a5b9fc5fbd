"""At the extremes nothing untold passes as detected or solved.

The regimes are the files of pipelines/extremes; ``python -m tests.benchmarks extremes`` prints
what every solver does there.
"""

import numpy as np
import pytest

from benchmarks.bench_extremes import FILES, broken_promises, measured
from support.lengths import lengths
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import EstimateStatus, Flipped

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
def test_all_that_is_detected_or_solved_is_finite_and_nothing_is_raised_or_printed(
    name, count, capfd
):
    assert broken_promises(measured(Pipeline.from_toml(PATHS[name]), count)) == []
    assert capfd.readouterr() == ("", "")


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
