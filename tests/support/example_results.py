"""The small dataset of the examples of `sweep.analysis`: written down, nothing is drawn."""

import numpy as np
import xarray as xr
from scipy import special

from sweep.experiment.schema import POSE_PARAMETERS, XYZ
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

SIDES = [10.0, 20.0, 40.0]
TRIALS = 8
SOLVERS = ["ippe", "iterative"]


def example_results():
    """Return two solvers at three sides, eight draws each: 0, 5 and 8 detected and solved.

    Of the second solver three poses are flipped, and its errors are twice as large.
    """
    shape = (len(SIDES), TRIALS, len(SOLVERS))
    detected = np.arange(TRIALS) < np.array([0, 5, 8])[:, None]
    solved = np.broadcast_to(detected[..., None], shape)
    flipped = np.zeros(shape, dtype=bool)
    flipped[2, :3, 1] = True
    # Errors between -1 and 1, all different, twice as large with the second solver.
    pattern = np.cos(np.arange(3 * len(SIDES) * TRIALS)).reshape(len(SIDES), TRIALS, 1, 3)
    pattern = np.where(solved[..., None], pattern * [[1.0], [2.0]], np.nan)
    nees = np.full(shape, np.nan)
    count = int(solved.sum())
    nees[solved] = special.chdtri(6, (np.arange(count) + 0.5) / count)
    depth = np.broadcast_to(30.0 / np.array(SIDES)[:, None], detected.shape)
    scene, detection, estimate = ("side_px", "trial"), ("side_px", "trial"), (
        "side_px", "trial", "solver")
    return xr.Dataset(
        {
            "true_rvec": ((*scene, "xyz"), np.broadcast_to(
                [np.pi, 0.0, 0.0], (*detected.shape, 3)).copy()),
            "true_tvec_m": ((*scene, "xyz"), np.stack([0 * depth, 0 * depth, depth], axis=-1)),
            "marker_area_px": (scene, np.broadcast_to(
                np.square(SIDES)[:, None], detected.shape).copy(), {"units": "px2"}),
            "bound_std": ((*scene, "pose_parameter"), np.full((*detected.shape, 6), 0.002)),
            "detection": (detection, np.where(
                detected, DetectionStatus.detected, DetectionStatus.no_candidate)),
            "corner_error_px": ((*detection, "corner", "xy"), np.zeros((*detected.shape, 4, 2))),
            "estimate": (estimate, np.where(
                solved, EstimateStatus.solved, EstimateStatus.no_detection)),
            "flipped": (estimate, np.select(
                [flipped, solved], [Flipped.flipped, Flipped.not_flipped], Flipped.no_estimate)),
            "rotation_error_rad": ((*estimate, "xyz"), np.radians(0.3 * pattern)),
            "translation_error_m": ((*estimate, "xyz"), 0.001 * pattern),
            "reprojection_error_px": (estimate, np.where(solved, 0.1, np.nan)),
            "alternative_reprojection_error_px": (estimate, np.where(
                solved & (np.array(SOLVERS) == "ippe"), np.array([[[0.1]], [[0.2]], [[0.5]]]),
                np.nan)),
            "nees": (estimate, nees),
        },
        {"side_px": SIDES, "trial": range(TRIALS), "solver": SOLVERS, "xyz": list(XYZ),
         "pose_parameter": list(POSE_PARAMETERS), "dictionary": "DICT_4X4_50"},
    )
