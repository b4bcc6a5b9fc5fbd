"""Errors of a pose along axes and about angles, signed: estimated minus true.

R and t are the true rotation and position of the marker in the camera's frame, E the rotation of
the error and d the error of position as stored: the estimated pose is E · R, t + d.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sweep.model.pose import angle_between, rotation_of_vector
from sweep.typing import Floats


@dataclass(frozen=True)
class SignedErrors:
    """Errors of poses, each component an array (...).

    Nothing cancels for small errors but the last digit of the true angle, and angles near 180
    degrees are as exact as others (atan2). NaN if any input is.

    Attributes
    ----------
    rvec, position_m
        Rotation vectors (..., xyz) and positions of the truth, camera frame.
    rotation_error_rad, position_error_m
        Errors (..., xyz), camera frame: the rotation vector of E, and d.

    Examples
    --------
    >>> frontal, quarter = np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, np.pi / 2])
    >>> away = np.array([0.0, 0.0, 2.0])
    >>> error = SignedErrors(frontal, away, quarter, np.array([0.0, 0.0, 0.5]))
    >>> error.yaw_pitch_roll_deg.round(9) + 0.0, error.in_plane_deg.round(9)
    (array([ 0.,  0., 90.]), np.float64(-90.0))
    >>> error.of_camera_m.round(9) + 0.0
    array([0. , 0. , 0.5])
    """

    rvec: Floats
    position_m: Floats
    rotation_error_rad: Floats
    position_error_m: Floats

    @cached_property
    def in_camera_m(self) -> Floats:
        """d, (..., xyz): the position's error along the axes of the camera."""
        return np.asarray(self.position_error_m, dtype=np.float64)

    @cached_property
    def along_marker_m(self) -> Floats:
        """Rᵀ d, (..., xyz): the position's error along the axes of the true marker."""
        return self._in_marker_frame(self.in_camera_m)

    @cached_property
    def of_camera_m(self) -> Floats:
        """Error (..., xyz) of the camera's position in the marker's frame.

        The camera is at -Rᵀ t, a robot that knows the marker's place believes to be at
        -(E R)ᵀ (t + d): the error is -Rᵀ (Eᵀ (t + d) - t).
        """
        moved = self.in_camera_m + self._turned(self.position_m + self.in_camera_m, -1.0)
        return -self._in_marker_frame(moved)

    @cached_property
    def yaw_pitch_roll_deg(self) -> Floats:
        """Differences (..., 3) of the angles of R = Ry(yaw) · Rx(pitch) · Rz(roll) · Rx(180°).

        In [-180, 180]; yaw and roll are not defined at a pitch of 90 degrees.
        """
        return wrapped_deg(_angles(self._estimated) - _angles(self._rotation))

    @cached_property
    def tilt_deg(self) -> Floats:
        """Difference (...) of the angles between the marker's plane and the image plane."""
        optical_axis = np.array([0.0, 0.0, 1.0])
        return self._difference(optical_axis, optical_axis)

    @cached_property
    def viewing_angle_deg(self) -> Floats:
        """Difference (...) of the angles between the normal and the line of sight to the centre."""
        return self._difference(self.position_m + self.in_camera_m, self.position_m)

    @cached_property
    def in_plane_deg(self) -> Floats:
        """The part of E (...) about the true normal, in [-180, 180]: its twist.

        With the quaternion (w, v) of E and the normal n it is 2 atan2(v · n, w), which is what is
        left of E if the shortest rotation that moves the normal as E does comes after it:
        Dobrowolski, "Swing-twist decomposition in Clifford algebra", arXiv:1506.05481, 2015.
        """
        error = np.asarray(self.rotation_error_rad, dtype=np.float64)
        half = np.linalg.norm(error, axis=-1) / 2.0
        along = (error * self._rotation[..., 2]).sum(axis=-1)
        sine = along * np.sinc(half / np.pi) / 2.0  # sin(half) / angle is sinc / 2
        return np.asarray(np.degrees(2.0 * np.arctan2(sine, np.cos(half))))

    @cached_property
    def _rotation(self) -> Floats:
        """R, (..., 3, 3)."""
        return rotation_of_vector(np.asarray(self.rvec, dtype=np.float64))

    @cached_property
    def _estimated(self) -> Floats:
        """E · R, (..., 3, 3)."""
        columns = np.swapaxes(self._rotation, -1, -2)
        return np.swapaxes(columns + self._turned(columns, 1.0, inner=1), -1, -2)

    def _in_marker_frame(self, vectors: Floats) -> Floats:
        return np.asarray(np.einsum("...ij,...i->...j", self._rotation, vectors))

    def _turned(self, vectors: Floats, sign: float, inner: int = 0) -> Floats:
        """Return (E - 1) v, or (Eᵀ - 1) v for a sign of -1: Rodrigues' formula.

        ``inner`` axes stand before the last of ``vectors``.
        """
        error = sign * np.asarray(self.rotation_error_rad, dtype=np.float64)
        error = error.reshape(*error.shape[:-1], *[1] * inner, 3)
        angle = np.linalg.norm(error, axis=-1, keepdims=True)
        across = np.cross(error, vectors)
        # sin(a) / a, and (1 - cos(a)) / a² without a difference
        return np.asarray(np.sinc(angle / np.pi) * across
                          + 0.5 * np.sinc(angle / (2.0 * np.pi))**2 * np.cross(error, across))

    def _difference(self, estimated: Floats, true: Floats) -> Floats:
        """Return the angle of the estimated normal to a direction minus that of the true one."""
        return np.asarray(np.degrees(angle_between(self._estimated[..., 2], -estimated)
                                     - angle_between(self._rotation[..., 2], -true)))


def _angles(rotation: Floats) -> Floats:
    """Return yaw, pitch and roll (..., 3) in radians, of R = Ry · Rx · Rz · Rx(180°)."""
    across, down, along = rotation[..., 0, 2], rotation[..., 1, 2], rotation[..., 2, 2]
    return np.stack([
        np.arctan2(-across, -along), np.arctan2(down, np.hypot(across, along)),
        np.arctan2(rotation[..., 1, 0], -rotation[..., 1, 1])], axis=-1)


def wrapped_deg(angle: Floats) -> Floats:
    """Return angles in radians as degrees in [-180, 180].

    Examples
    --------
    >>> wrapped_deg(np.radians([-350.0, 180.0, 179.0])).round(9).tolist()
    [10.0, 180.0, 179.0]
    """
    return np.degrees(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))
