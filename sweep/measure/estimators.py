"""The solvers: one record each, from a setting to its estimator; plug-ins and recordings."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from sweep.declaration import drawn, parameter
from sweep.errors import PluginError
from sweep.measure.detectors import PluginSetting
from sweep.measure.estimation import Detections, Estimates, PoseEstimator, credible_estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.photometric import Photometric, PhotometricReal
from sweep.measure.solver import OPENCV_SOLVERS, Solver
from sweep.model.lens import COUNTS
from sweep.plugins import Poses
from sweep.plugins.loading import DeclaredPlugin, call, real_numbers

# --------------------------------------------------------------------------------------------------
# A plug-in's solver: what it returns is checked as our own solvers' poses are.

#: How far a rotation matrix times its transpose may be from the unit matrix.
ROTATION_ATOL = 1e-6


def plugged(setting: PluggedEstimatorSetting) -> PoseEstimator:
    """Return the estimator of a plug-in's solver in this process.

    Errors and covariances are those of the corners of all squares that were found, whichever of
    them the plug-in uses. It raises PluginError, in one line, if the plug-in raises, or returns
    what cannot be poses.
    """
    name, solve = setting.solver, setting.own.made()

    def estimates(detections: Detections) -> Estimates:
        count = len(detections)
        if count == 0:
            return Estimates.none(0, EstimateStatus.solver_failed)
        # Of a copy: what a plug-in does to it reaches nobody else.
        copied = detections.take(np.arange(count))
        copied = dataclasses.replace(copied, images=[np.array(image) for image in copied.images])
        poses = checked_poses(name, call(name, solve, copied), count)
        alternative = None
        if poses.alternative_rotation is not None:
            alternative = poses.alternative_rotation, poses.alternative_translation
        return credible_estimates(
            detections, poses.rotation, poses.translation, setting.reprojection_limit,
            alternative=alternative, covariance=poses.covariance,
            corner_noise_px=setting.corner_noise_px,
        )

    return estimates


def checked_poses(plugin: str, returned: Any, count: int) -> Poses:
    """Return a plug-in's poses: arrays of the right shapes, and rotations that are rotations.

    Raises
    ------
    PluginError
        If they are none.
    """
    if not isinstance(returned, tuple) or not 2 <= len(returned) <= 5:
        raise PluginError(
            f"{plugin}: returned a {type(returned).__name__}; expected a tuple "
            "(rotation, translation)"
        )
    given = Poses(*returned)
    if (given.alternative_rotation is None) != (given.alternative_translation is None):
        raise PluginError(
            f"{plugin}: returned half an alternative; expected its rotation and translation"
        )
    shapes, arrays = ((3, 3), (3,), (6, 6), (3, 3), (3,)), {}
    for (name, value), shape in zip(given._asdict().items(), shapes, strict=True):
        if value is not None:
            array = real_numbers(plugin, f"a {name}", value, (count, *shape))
            array[~np.isfinite(array).reshape(count, -1).all(axis=1)] = np.nan
            arrays[name] = array
    for name in arrays.keys() & {"rotation", "alternative_rotation"}:
        known = arrays[name][~np.isnan(arrays[name][:, 0, 0])]
        gram = np.swapaxes(known, 1, 2) @ known
        off = np.abs(gram - np.eye(3)).max(initial=0.0)
        if off > ROTATION_ATOL or (np.linalg.det(known) < 0).any():
            raise PluginError(
                f"{plugin}: returned a {name} that is no rotation matrix ({off:.2g} off)"
            )
    return Poses(**arrays)


# --------------------------------------------------------------------------------------------------
# Poses that another program estimated, as an estimator.

def given_poses(limit: float, detections: Detections) -> Estimates:
    """Return the poses that came with recorded detections.

    solver_failed where there is none, none in front of the camera, or the RMS reprojection error
    exceeds ``limit``, a share of the mean side of the detected quadrilateral, as for solvers.
    """
    rotation, translation = detections.recorded_rotation, detections.recorded_translation
    if rotation is None or translation is None:
        return Estimates.none(len(detections), EstimateStatus.solver_failed)
    return credible_estimates(detections, rotation, translation, limit)


# --------------------------------------------------------------------------------------------------
# The solvers: one record each, the estimator's settings, and from a setting to its estimator.

#: Name in pipeline files -> the solver; choices, messages and reference follow from it.
SOLVERS: dict[str, Solver] = {
    **OPENCV_SOLVERS,
    "photometric": Solver(
        meaning="maximum likelihood on the pixels, started from ippe",
        make=lambda setting: Photometric(setting.refined_starts, setting.estimate_blur),
        own=("refined_starts", "estimate_blur"), needs_images=True, of_boards=True,
    ),
    "photometric_real": Solver(
        meaning="least squares on the pixels of photographs: what else is on the board, point "
        "spread and tone are in the model, noise is estimated",
        make=lambda setting: PhotometricReal(
            setting.refined_starts, spread_free=True, tone=setting.estimate_tone
        ),
        own=("refined_starts", "estimate_tone"), needs_images=True, planar_only=True,
    ),
    "recorded": Solver(
        meaning="the poses that came with the detections which `sweep score` recorded",
        make=lambda setting: partial(given_poses, setting.reprojection_limit),
        recorded=True, of_boards=True,
    ),
}

_PLAIN = ", ".join(
    name for name, each in SOLVERS.items()
    if not (each.guarded or each.needs_images or each.recorded)
)
_PIXELS = ", ".join(name for name, each in SOLVERS.items() if each.needs_images)

_ASSUMED = "as assumed by the estimator (default: the true one)"


@dataclass(frozen=True, slots=True)
class EstimatorSetting:
    """How a pose is estimated, and which camera and marker the estimator assumes."""

    solver: str = parameter(
        "ippe_square", "; ".join(f"{name}: {each.meaning}" for name, each in SOLVERS.items()),
        choices=tuple(SOLVERS), prefix="SOLVEPNP_", plugin="estimator",
    )
    guarded: bool = parameter(
        True, "true: the solver is called in a frame in which it is stable, checked, and replaced "
        "by iterative (far away by ippe) if it fails; false: the plain cv2.solvePnP call "
        f"({_PLAIN} always)",
    )
    reprojection_limit: float = parameter(
        0.25, "largest RMS reprojection error of a solution, as a share of the detected side; of a "
        "pose at infinity it is 0.7", 0, 0.5, open_low=True,
    )
    corner_noise_px: float | None = parameter(
        None, "standard deviation of a detected corner's coordinates, for the pose covariance of "
        f"solvers that use corners alone; {_PIXELS} computes its own from the pixels", 1e-6, 1e6,
    )
    refined_starts: bool = parameter(
        False, "photometric and photometric_real also start from the detector's corners after "
        "cv2.cornerSubPix: four starts instead of two",
    )
    points: str = parameter(
        "markers", "boards: the points that the pose is estimated from. markers: the corners of "
        "all detected markers; chessboard: the interpolated corners of a charuco's squares; "
        "largest_marker: the corners of the largest detected marker; each_marker: both planar "
        "solutions of each marker, of which the one counts that fits all corners best",
        choices=("markers", "chessboard", "largest_marker", "each_marker"),
    )
    refine: str = parameter(
        "none", "boards: refinement of the solver's pose on all its points. lm: "
        "cv2.solvePnPRefineLM; vvs: cv2.solvePnPRefineVVS",
        choices=("none", "lm", "vvs"),
    )
    estimate_blur: bool = parameter(
        False, "photometric also estimates the point spread, starting from believed_blur_px; "
        "photometric_real always does",
    )
    estimate_tone: bool = parameter(
        True, "photometric_real estimates a tone curve, a term in s (1 - s) of white's share s"
    )
    believed: str = parameter(
        "truth", "the camera that is assumed where no other belief says otherwise. truth: the true "
        "one; calibration: in each trial the true one with an error drawn from calibration_sd or "
        "calibration_covariance",
        choices=("truth", "calibration"),
    )
    believed_focal_scale: float | None = drawn(
        None, "factor on both true focal lengths that is assumed: 1.01 is a focal length believed "
        "1 % too long", 1e-3, 1e3,
    )
    believed_fx_px: float | None = drawn(
        None, f"focal length along x {_ASSUMED}; that along y stays as it is", 1e-3, 1e9
    )
    believed_fy_px: float | None = drawn(None, f"focal length along y {_ASSUMED}", 1e-3, 1e9)
    believed_cx_px: float | None = drawn(None, f"principal point, x, {_ASSUMED}", -1e9, 1e9)
    believed_cy_px: float | None = drawn(None, f"principal point, y, {_ASSUMED}", -1e9, 1e9)
    believed_distortion: tuple[float, ...] | None = parameter(
        None, f"lens coefficients {_ASSUMED}", lengths=COUNTS
    )
    believed_size_m: float | None = drawn(None, f"side of the black square {_ASSUMED}", 1e-9, 1e9)
    believed_blur_px: float | None = parameter(
        None, f"Gaussian point spread {_ASSUMED}", 0, 1000
    )
    believed_noise_grey: float | None = parameter(
        None, f"noise of a pixel {_ASSUMED}", 0, 1e6, unit="grey level"
    )

    @property
    def record(self) -> Solver | DeclaredPlugin:
        """What is declared of its solver; a plug-in is not imported for it."""
        return SOLVERS[self.solver]


@dataclass(frozen=True, slots=True, kw_only=True)
class PluggedEstimatorSetting(EstimatorSetting):
    """The setting of a plug-in's solver: ours, and ``own``."""

    own: PluginSetting

    @property
    def record(self) -> DeclaredPlugin:
        """The plug-in."""
        return self.own.plugin


@lru_cache(maxsize=1024)
def build(setting: EstimatorSetting) -> PoseEstimator:
    """Return the estimator that a setting describes; kept by the process.

    Raises
    ------
    PluginError
        If a plug-in cannot be used.
    """
    if isinstance(setting, PluggedEstimatorSetting):
        return plugged(setting)
    return SOLVERS[setting.solver].make(setting)
