"""Poses from markers' own corners, where no board knows better: of one image, or of two.

Corners by OpenCV's subpix refinement, poses by IPPE: the better of the two planar solutions in
one image, or in two images the one that fits both of them better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.measure.accuracy import rotation_difference
from sweep.measure.flags import TruthSource
from sweep.measure.solver import both_planar_solutions, reprojection_errors_px
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.marker import marker_corners
from sweep.photographs.pose_fit import MAD_TO_STD, Lens
from sweep.photographs.poses import Poses
from sweep.typing import Floats, Integers

MIN_PAIRS = 12
"""Markers seen by both cameras from which the spread of their poses is estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenMarkers:
    """Markers that were detected in a photograph: indices (k,) and corners (k, 4, 2) px."""

    marker: Integers
    quads: Floats


@dataclass(frozen=True, slots=True, eq=False)
class StereoCamera:
    """Two cameras: a point X in the left one's frame is ``rotation @ X + translation`` (m)."""

    left: Lens
    right: Lens
    rotation: Floats
    translation: Floats

    def swapped(self) -> StereoCamera:
        """Return the same with left and right exchanged."""
        back = self.rotation.T
        return StereoCamera(self.right, self.left, back, -back @ self.translation)


def cameras_of(lens: Lens, count: int) -> Cameras:
    """Return ``count`` equal cameras as solvers take them."""
    matrix = lens.matrix
    view = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    packed = pack(tuple(lens.distortion.tolist()))
    return Cameras(
        np.repeat(view[None], count, axis=0), np.repeat(packed[None], count, axis=0),
        np.full(count, bool(packed[:14].any())),
    )


def own_poses(lens: Lens, sizes_m: Floats, seen: Sequence[SeenMarkers]) -> Poses:
    """Return the poses of M markers, of sides (M,), in P photographs from their own corners."""
    poses = Poses.none(len(seen), len(sizes_m))
    for photograph, each in enumerate(seen):
        count = len(each.marker)
        if not count:
            continue
        rotation, translation = both_planar_solutions(
            each.quads, cameras_of(lens, count), sizes_m[each.marker]
        )
        for k, marker in enumerate(each.marker.tolist()):
            if np.isfinite(rotation[k, 0]).all() and translation[k, 0, 2] > 0:
                poses.put(photograph, marker, rotation[k, 0], translation[k, 0],
                          np.full(6, np.nan), TruthSource.none)
    return poses


def partner_poses(
    stereo: StereoCamera, size: tuple[int, int], sizes_m: Floats, left: Sequence[SeenMarkers],
    right: Sequence[SeenMarkers],
) -> Poses:
    """Return the poses of M markers in P left photographs, from the right ones of the same moment.

    Their standard deviations are those of the differences between left and right poses, over √2:
    robust ones over all markers, since those of one marker are not known.

    Parameters
    ----------
    stereo
        The cameras.
    size
        Width and height of the left photographs in pixels.
    sizes_m
        (M,) sides of the markers.
    left, right
        P each.
    """
    poses = Poses.none(len(right), len(sizes_m))
    differences = []
    back = stereo.rotation.T
    for photograph, (own, partner) in enumerate(zip(left, right, strict=True)):
        count = len(partner.marker)
        if not count:
            continue
        sides = sizes_m[partner.marker]
        right_rotation, right_translation = both_planar_solutions(
            partner.quads, cameras_of(stereo.right, count), sides
        )
        rotation = back @ right_rotation
        translation = (right_translation - stereo.translation) @ stereo.rotation
        errors = _errors(stereo.right, partner.quads, sides, right_rotation, right_translation)
        index = {marker: k for k, marker in enumerate(own.marker.tolist())}
        for k, marker in enumerate(partner.marker.tolist()):
            total = errors[k].copy()
            if marker in index:
                quad = own.quads[index[marker]]
                total += _errors(
                    stereo.left, np.repeat(quad[None], 1, axis=0), sides[k : k + 1],
                    rotation[k : k + 1], translation[k : k + 1],
                )[0]
            if not np.isfinite(total).any():
                continue
            best = int(np.nanargmin(total))
            pose = rotation[k, best], translation[k, best]
            if not is_within(stereo.left, size, sides[k], *pose):
                continue
            poses.put(photograph, marker, *pose, np.full(6, np.nan), TruthSource.stereo_partner)
            if marker in index:
                differences.append(_difference(stereo.left, quad, sides[k], *pose))
    known = [each for each in differences if each is not None]
    if len(known) >= MIN_PAIRS:
        spread = MAD_TO_STD * np.median(np.abs(np.array(known)), axis=0) / np.sqrt(2.0)
        poses.std[poses.known] = spread
    return poses


def _errors(
    lens: Lens, quads: Floats, sides: Floats, rotation: Floats, translation: Floats
) -> Floats:
    """Return the RMS reprojection errors (k, 2) of two poses each, px; NaN for none."""
    cameras = cameras_of(lens, len(quads))
    return np.stack([
        reprojection_errors_px(rotation[:, j], translation[:, j], sides, quads, cameras)
        for j in range(2)
    ], axis=1)


def _difference(
    lens: Lens, quad: Floats, side: float, rotation: Floats, translation: Floats
) -> Floats | None:
    """Return the difference (6,) of a marker's pose in this image to another; None for none."""
    own, shift = both_planar_solutions(quad[None], cameras_of(lens, 1), np.array([side]))
    turns = rotation_difference(own[0], np.repeat(rotation[None], 2, axis=0))
    angle = np.linalg.norm(turns, axis=1)
    if not np.isfinite(angle).any():
        return None
    best = int(np.nanargmin(angle))
    return np.concatenate([turns[best], shift[0, best] - translation])


def is_within(
    lens: Lens, size: tuple[int, int], side: float, rotation: Floats, translation: Floats
) -> bool:
    """Return whether a marker is wholly in the frame."""
    points = marker_corners(np.array([side]))[0]
    if not ((points @ rotation.T + translation)[:, 2] > 0).all():
        return False
    pixels = lens.project(points, rotation, translation)
    return bool(((pixels >= -0.5) & (pixels <= np.array(size) - 0.5)).all())
