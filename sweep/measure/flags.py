"""What became of a pose: the flags of detection and estimation. Values are only ever appended."""

from __future__ import annotations

from enum import IntEnum


class DetectionStatus(IntEnum):
    """What the detector made of the marker.

    "There" means: the quadrilateral's centre lies inside the true quadrilateral.
    """

    not_run = 0
    detected = 1
    """A quadrilateral there with the right ID and the right rotation of the corners."""
    wrong_id = 2
    """A decoded quadrilateral there, with another ID or rotation."""
    rejected = 3
    """A candidate there that could not be decoded."""
    no_candidate = 4
    """Nothing there."""
    not_visible = 5
    """Wholly outside the frame, seen from behind, or with a corner at z <= 0."""
    not_modelled = 6
    """The lens model folds there."""
    failed = 7
    """An exception was raised."""
    crashed = 8
    """The process died."""


class EstimateStatus(IntEnum):
    """What the solver made of the corners."""

    not_run = 0
    solved = 1
    no_detection = 2
    solver_failed = 3
    """No solution, one that is not finite or behind the camera, or one that does not reproject."""
    failed = 4
    """An exception was raised."""
    crashed = 5
    """The process died."""
    not_converged = 6
    """The likelihood's maximum was not reached."""
    not_explained = 7
    """The pixels are not explained by the estimator's model; its pose is kept beside the flag."""


class Flipped(IntEnum):
    """Whether a solution is nearer to the mirror of the truth than to the truth."""

    not_run = 0
    not_flipped = 1
    flipped = 2
    no_estimate = 3
