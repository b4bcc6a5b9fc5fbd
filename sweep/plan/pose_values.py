"""The pose in the ways that users give it, resolved to the one that scenes are made from.

A scene's pose is tilt, azimuth, roll, ``distance_m``, and bearings or ``x_m``, ``y_m``. The other
parameters of a pose are turned into these, step by step; a step whose parameters are not given does
nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.model.columns import Column
from sweep.model.marker import marker_corners, module_count, overhang
from sweep.model.placement import PER_SIDE, Framing
from sweep.model.pose import rotation_of_angles, transform_points
from sweep.model.rotations import (
    angles_of_rotation,
    rotation_of_view_angle,
    rotation_of_yaw_pitch_roll,
)
from sweep.model.scene import build_cameras
from sweep.model.world import orientation, pose_in_camera
from sweep.plan.alternatives import WORLD
from sweep.typing import Floats

Columns = dict[str, Column]

ANGLES = ("tilt_deg", "azimuth_deg", "roll_deg")
BEARINGS = ("bearing_x_deg", "bearing_y_deg")
CENTRE = ("x_m", "y_m")
SHARES = ("frame_x", "frame_y")
SHIFTS = ("shift_u_px", "shift_v_px")

DISTANCE_PARAMETERS = (*VIEW_PARAMETERS, "size_m", "side_px")
"""The parameters that :func:`distance_of_side` needs."""

KEY_DECIMALS = 10
"""Decimals of degrees to which resolved angles enter the geometry key: they have rounding errors
where angles that are given have none."""


def distance_of_side(values: Mapping[str, Any]) -> Any:
    """Return the distance in m at which the black square's side is ``side_px`` long.

    ``fx · size / side``; ``values`` has numbers or arrays for :data:`DISTANCE_PARAMETERS`.
    """
    fx = intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0]
    return fx * values["size_m"] / values["side_px"]


def resolve_pose(values: Columns) -> None:
    """Add the parameters that scenes are made from to values, of which none is to be drawn yet.

    The angles have names of their own: ``roll_deg`` of yaw, pitch and roll stays as it is given.
    """
    pose = dict(values)
    for step in STEPS:
        if step.is_given(pose):
            pose.update(step.take(pose))
    values.update({name: pose[name] for name in ("distance_m", *CENTRE)})
    values.update({f"resolved_{name}": pose[name] for name in ANGLES})


def canonical_pose(values: Mapping[str, Column], drawn: Collection[str]) -> Columns:
    """Return the values with a pose that is the same in whichever way it is given.

    That is tilt, azimuth, roll, distance and bearings, without jitter. What follows from values
    that are ``drawn`` stays as it is given.
    """
    canonical: Columns = {**values, **dict.fromkeys(SHIFTS, Column.of(0.0))}
    unknown = set(drawn)
    for step in (*STEPS, _TO_BEARINGS):
        if unknown.intersection(step.given):
            unknown.update(step.makes)
        elif step.is_given(canonical):
            if unknown.intersection(step.others):
                unknown.update(step.makes)
                continue
            made = step.take(canonical)
            canonical |= dict.fromkeys(step.given, Column.of(None))
            canonical |= {name: _rounded(name, column) for name, column in made.items()}
    return canonical


def _rounded(name: str, column: Column) -> Column:
    if not name.endswith("_deg"):
        return column
    return Column(np.round(column.values, KEY_DECIMALS) + 0.0, column.constant)


@dataclass(frozen=True, slots=True)
class Step:
    """The resolution of one way in which a part of the pose is given.

    Attributes
    ----------
    given
        The parameters of this way: the step is taken if one of them is given.
    others
        What it reads beside them.
    makes
        What it resolves.
    resolve
        Returns the values (n,) of ``makes`` for n scenes.
    """

    given: tuple[str, ...]
    others: tuple[str, ...]
    makes: tuple[str, ...]
    resolve: Callable[[Mapping[str, Column], int], tuple[Floats, ...]]

    def is_given(self, values: Mapping[str, Column]) -> bool:
        """Return whether one of the parameters has a value."""
        return any(name in values and not values[name].missing for name in self.given)

    def take(self, values: Mapping[str, Column]) -> Columns:
        """Return the columns that it makes: of one value where all scenes share what it reads."""
        read = [values[name] for name in (*self.given, *self.others) if name in values]
        each = [len(column.values) for column in read if not column.constant]
        made = self.resolve(values, each[0] if each else 1)
        return {
            name: Column.of(array) if each else Column.of(float(array[0]))
            for name, array in zip(self.makes, made, strict=True)
        }


def _numbers(
    values: Mapping[str, Column], names: Collection[str], count: int, missing: float = 0.0
) -> list[Floats]:
    """Return parameters as arrays (count,); ``missing`` stands for one that is not given."""
    columns = [values.get(name, Column.of(None)) for name in names]
    return [
        np.full(count, missing) if column.missing else column.broadcast(count)
        for column in columns
    ]


def _from_side(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    numbers = {name: values[name].values for name in DISTANCE_PARAMETERS}
    return (Column.of(distance_of_side(numbers)).broadcast(count),)


def _from_world(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    """Resolve the places of camera and marker in the world."""
    numbers = dict(zip(WORLD, _numbers(values, WORLD, count), strict=True))
    located = []
    for whose in ("camera", "marker"):
        angles = (np.radians(numbers[f"{whose}_{name}_deg"]) for name in ("yaw", "pitch", "roll"))
        origin = np.stack([numbers[f"{whose}_{axis}_m"] for axis in "xyz"], axis=1)
        located += [origin, orientation(*angles)]
    rotation, position = pose_in_camera(*located)
    return (*_angles(rotation), *position.T)


def _from_yaw_and_pitch(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    angles = _numbers(values, ("yaw_deg", "pitch_deg", "roll_deg"), count)
    return _angles(rotation_of_yaw_pitch_roll(*map(np.radians, angles)))


def _angles(rotation: Floats) -> tuple[Floats, ...]:
    return tuple(np.degrees(angle) for angle in angles_of_rotation(rotation))


def _from_view_angle(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    """Resolve the angle to the line of sight, which jitter moves, too."""
    depth = values["distance_m"].broadcast(count)
    centre_xy = _centres(values, count) + _shifts(values, count)
    return _angles(_facing(values, count)(np.arange(count), np.column_stack([centre_xy, depth])))


def _facing(
    values: Mapping[str, Column], count: int
) -> Callable[[NDArray[np.intp], Floats], Floats]:
    """Return the function of rows (n,) and positions (n, 3) that returns the rotations there."""
    tilt, azimuth, roll = map(np.radians, _numbers(values, ANGLES, count))
    if values["view_angle_deg"].missing:
        rotation = rotation_of_angles(tilt, azimuth, roll)
        return lambda rows, _: rotation[rows]
    view = np.radians(values["view_angle_deg"].broadcast(count))
    return lambda rows, position: rotation_of_view_angle(
        view[rows], azimuth[rows], roll[rows], position
    )


def _centres(values: Mapping[str, Column], count: int) -> Floats:
    """Return the centre's x and y (count, 2) in metres, without jitter."""
    depth = values["distance_m"].broadcast(count)
    return np.stack([
        depth * np.tan(np.radians(values[bearing].broadcast(count)))
        if values[metres].missing else values[metres].broadcast(count)
        for metres, bearing in zip(CENTRE, BEARINGS, strict=True)
    ], axis=1)


def _shifts(
    values: Mapping[str, Column], count: int, names: tuple[str, str] = SHIFTS
) -> Floats:
    """Return what the jitter's pixels are at the centre's depth, along x and y, (count, 2) m."""
    focal = intrinsics(
        *(None if values[name].missing else values[name].broadcast(count)
          for name in VIEW_PARAMETERS)
    )[:2]
    depth, pixels = values["distance_m"].broadcast(count), _numbers(values, names, count)
    return np.stack(
        [depth * (pixel / length) for pixel, length in zip(pixels, focal, strict=True)], axis=1
    )


def _from_frame(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    """Resolve the place between those at which the marker touches the frame."""
    cameras = build_cameras(values, count)
    modules = values["dictionary"].map(module_count).broadcast(count)
    size, quiet = _numbers(values, ("size_m", "quiet_zone_modules"), count)
    margin = quiet + values["dictionary"].map(overhang).broadcast(count)
    outline = marker_corners(size * (1 + 2 * margin / modules))
    depth = values["distance_m"].broadcast(count)
    facing, given = _facing(values, count), _centres(values, count)
    shift = _shifts(values, count)
    margin = _shifts(values, count, ("jitter_px", "jitter_px"))
    frame = np.stack(_numbers(values, ("width_px", "height_px"), count), axis=1)
    share = np.stack(_numbers(values, SHARES, count, np.nan), axis=1)
    centres = np.empty((count, 2))
    # What a scene gets must not depend on whether others have a lens.
    for curved in (False, True):
        rows = np.flatnonzero(cameras.distorted == curved)
        points = _along_sides(outline[rows], PER_SIDE if curved else 1)

        def offsets(
            part: NDArray[np.intp], centre_xy: Floats, rows: NDArray[np.intp] = rows,
            points: Floats = points,
        ) -> Floats:
            position = np.column_stack([centre_xy, depth[rows[part]]])
            rotation = facing(rows[part], position)
            return transform_points(points[part], rotation, np.zeros_like(position))

        centres[rows] = Framing(
            cameras.take(rows), frame[rows], depth[rows], offsets, share[rows], given[rows],
            margin[rows], shift[rows],
        ).centres()
    return tuple(centres.T)


def _along_sides(corners: Floats, per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 3) along the sides of quadrilaterals (n, 4, 3)."""
    t = (np.arange(per_side) / per_side)[:, None]
    following = np.roll(corners, -1, axis=1)
    points = corners[:, :, None] + t * (following - corners)[:, :, None]
    return points.reshape(len(corners), 4 * per_side, 3)


def _bearings(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    depth, centres = values["distance_m"].broadcast(count), _centres(values, count)
    return tuple(np.degrees(np.arctan2(across, depth)) for across in centres.T)


_POSITION = ("distance_m", *CENTRE, *BEARINGS, *SHIFTS, *VIEW_PARAMETERS)

STEPS = (
    Step(("side_px",), (*VIEW_PARAMETERS, "size_m"), ("distance_m",), _from_side),
    Step(WORLD, (), (*ANGLES, *CENTRE, "distance_m"), _from_world),
    Step(("yaw_deg", "pitch_deg"), ("roll_deg",), ANGLES, _from_yaw_and_pitch),
    Step(
        SHARES,
        (*_POSITION, *ANGLES, "view_angle_deg", "distortion", "jitter_px", "size_m",
         "quiet_zone_modules", "dictionary"),
        CENTRE, _from_frame,
    ),
    Step(
        ("view_angle_deg",), ("azimuth_deg", "roll_deg", *_POSITION), ANGLES, _from_view_angle,
    ),
)
"""Every step, each after those that make what it reads."""

_TO_BEARINGS = Step(CENTRE, ("distance_m", *BEARINGS), BEARINGS, _bearings)
