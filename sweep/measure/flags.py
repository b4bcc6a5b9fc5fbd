"""Flags of detection, estimation and the accuracy bound.

Every flag of the dataset is declared here and nowhere else; attributes, checks of consistency,
outcomes and tables are derived from the members. Values are only ever appended, since stores hold
them.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class Flag(IntEnum):
    """Base class of a stage's flags.

    Attributes
    ----------
    meaning
        One sentence, for attributes, guides and the report.
    counted
        The pose is in the denominator of the stage's rates ("looked for").
    present
        The numbers of the stage exist beside this flag.
    ends
        The pose goes no further: the flag is an outcome of its own. False if a later stage
        decides, or if an earlier one did.

    Examples
    --------
    >>> DetectionStatus(1).name, DetectionStatus.detected.present
    ('detected', True)
    >>> [flag.name for flag in EstimateStatus if flag.present]
    ['solved', 'not_explained']
    """

    meaning: str
    counted: bool
    present: bool
    ends: bool

    def __new__(
        cls, value: int, meaning: str = "", counted: bool = True, present: bool = False,
        ends: bool = True,
    ) -> Self:
        """Return the member with an integer ``value``; the rest are its attributes."""
        member = int.__new__(cls, value)
        member._value_ = value
        member.meaning = meaning
        member.counted = counted
        member.present = present
        member.ends = ends
        return member


def flag(
    value: int, meaning: str, *, counted: bool = True, present: bool = False, ends: bool = True
) -> Any:
    """Return the declaration of a member of a :class:`Flag` (arguments as there)."""
    return value, meaning, counted, present, ends


class DetectionStatus(Flag):
    """Result of the search for the marker.

    A quadrilateral is "at the marker" if its centre lies inside the true quadrilateral.
    """

    not_run = flag(0, "The pose was not computed.", counted=False)
    detected = flag(
        1, "A quadrilateral at the marker has the right ID and the right rotation of its corners.",
        present=True, ends=False,
    )
    wrong_id = flag(
        2, "A quadrilateral at the marker was decoded with another ID or rotation."
    )
    rejected = flag(3, "A candidate at the marker could not be decoded.")
    no_candidate = flag(4, "No candidate at the marker.")
    not_visible = flag(
        5, "The marker is wholly outside the frame, seen from behind, or has a corner at z <= 0.",
        counted=False,
    )
    not_modelled = flag(
        6, "The image folds at the marker: by the lens model, a bent sheet or shifts.",
        counted=False,
    )
    failed = flag(7, "An exception was raised.")
    crashed = flag(8, "The process died.")
    not_needed = flag(9, "The precision that was asked for did not need the trial.", counted=False)
    not_in_photograph = flag(
        10, "The photograph does not show the whole marker, or its pose is not known.",
        counted=False,
    )
    not_on_board = flag(11, "The scene's board has fewer markers than another.", counted=False)
    no_board = flag(12, "The photograph shows no marker of its board: all of them are missed.")


class TruthSource(Flag):
    """Origin of the true pose of a marker in a photograph."""

    not_run = flag(0, "The pose was not computed.", counted=False)
    none = flag(1, "No truth: errors are relative to a pose from the marker's own corners.")
    board_without_this_marker = flag(
        2, "The pose of the board, fitted to all its corners except those of this marker.",
        present=True,
    )
    poses_file = flag(3, "A file of poses that the user gave.", present=True)
    stereo_partner = flag(
        4, "The pose in the other camera's image of the same moment.", present=True
    )


class EstimateStatus(Flag):
    """Result of the pose estimation."""

    not_run = flag(0, "The estimate was not computed.", counted=False)
    solved = flag(1, "The estimator returned a pose.", present=True)
    no_detection = flag(2, "The marker was not detected.", ends=False)
    solver_failed = flag(
        3, "The solver returned no solution, or one that is not finite, lies behind the camera or "
        "exceeds the limit of the reprojection error.",
    )
    failed = flag(4, "An exception was raised.")
    crashed = flag(5, "The process died.")
    not_converged = flag(6, "The iteration did not reach the maximum of the likelihood.")
    not_explained = flag(
        7, "The estimator's model does not explain the pixels; the pose is stored all the same.",
        present=True,
    )
    not_needed = flag(8, "The precision that was asked for did not need the trial.", counted=False)
    too_few_points = flag(9, "Fewer than four points of the board were found.")


class BoundStatus(Flag):
    """Result of the accuracy bound."""

    not_run = flag(0, "The bound was not computed.", counted=False)
    given = flag(1, "The bound exists.", present=True)
    no_noise = flag(2, "The noise is below half a grey level: rounding dominates it.")
    no_contrast = flag(
        3, "The image hardly changes with some component of the pose: it cannot be estimated."
    )
    clipped = flag(
        4, "A grey level lies within two standard deviations of the noise of the scale's ends."
    )
    not_in_model = flag(5, "An active effect is not part of the bound's model of the image.")
    not_visible = flag(6, "The marker is not visible, or not modelled.", counted=False)
    not_needed = flag(7, "The precision that was asked for did not need the trial.", counted=False)


class CalibrationStatus(Flag):
    """Result of a camera's calibration from a set of views."""

    not_run = flag(0, "There are too few trials for another set of as many views.", counted=False)
    calibrated = flag(1, "OpenCV returned a camera.", present=True)
    too_few_views = flag(2, "The board was found in too few views.")
    failed = flag(3, "OpenCV raised, or returned what is not finite.")


class Flipped(Flag):
    """Whether the solution is nearer to the mirror of the truth than to the truth."""

    not_run = flag(0, "The estimate was not computed.", counted=False)
    not_flipped = flag(1, "The solution is nearer to the truth.", present=True)
    flipped = flag(2, "The solution is nearer to the mirror of the truth.", present=True)
    no_estimate = flag(3, "There is no solution.", counted=False)
    not_needed = flag(4, "The precision that was asked for did not need the trial.", counted=False)


class Ambiguous(Flag):
    """Whether another pose explains the pixels about as well; ``photometric_real`` judges it."""

    not_run = flag(0, "The estimate was not computed.", counted=False)
    clear = flag(1, "The pixels rule other poses out.", present=True)
    ambiguous = flag(2, "Another pose explains the pixels about as well.", present=True)
    not_judged = flag(3, "There is no pose, or the solver does not judge it.", counted=False)
    not_needed = flag(4, "The precision that was asked for did not need the trial.", counted=False)


def present_values(flags: Iterable[Flag]) -> list[int]:
    """Return the values of the flags beside which the stage's numbers exist.

    Examples
    --------
    >>> present_values(EstimateStatus)
    [1, 7]
    """
    return [int(member) for member in flags if member.present]


def flag_counts(flags: type[Flag], values: NDArray[np.uint8]) -> dict[str, int]:
    """Return how often each flag that occurs does, by name.

    >>> flag_counts(DetectionStatus, np.array([[1, 1], [3, 1]], dtype=np.uint8))
    {'detected': 3, 'rejected': 1}
    """
    counts = np.bincount(values.ravel()).tolist()
    return {flag.name: count for flag, count in zip(flags, counts, strict=False) if count}


def uncounted_values(flags: Iterable[Flag]) -> list[int]:
    """Return the values of the flags of poses that are in no denominator.

    Examples
    --------
    >>> uncounted_values(DetectionStatus)
    [0, 5, 6, 9, 10, 11]
    """
    return [int(member) for member in flags if not member.counted]


def outcomes(counted: bool) -> tuple[str, ...]:
    """Return the names of the outcomes of a pose that are counted, or of those that are not.

    An outcome is a flag of detection or of estimation with which a pose ends. In the order of the
    stages, ``solved`` first; names that both stages have (an exception, a crash) come last.

    Examples
    --------
    >>> outcomes(counted=False)
    ('not_visible', 'not_modelled', 'not_in_photograph', 'not_on_board', 'not_run', 'not_needed')
    """
    detection, estimation = (
        [member.name for member in flags if member.ends and member.counted == counted]
        for flags in (DetectionStatus, EstimateStatus)
    )
    names = [EstimateStatus.solved.name] if counted else []
    names += [name for name in (*detection, *estimation)
              if (name in detection) != (name in estimation)]
    names += [name for name in detection if name in estimation]
    return tuple(dict.fromkeys(names))
