"""What a pipeline's poses are: how they are seen, how far away, and what may surprise of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.model.extent import hidden, outside_frame
from sweep.model.pose import viewing_angle
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.alternatives import WORLD
from sweep.plan.boards import target_word
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes, scene_values
from sweep.plan.parameters import PARAMETERS
from sweep.typing import Floats, Masks

MAX_SAMPLE = 600
"""Poses that are looked at, of a larger grid: its corners first, then poses anywhere."""

MAX_CORNERS = 200
"""The most corners of a grid that are looked at."""

APART_DEG = 5.0
"""Difference of tilt and viewing angle that is told."""

FARTHER = 1.1
"""Range over depth that is told: a direction of 25° from the optical axis."""

MIN_SHARE = 0.01
"""Share of poses that is told."""


@dataclass(frozen=True, slots=True)
class PoseFacts:
    """Poses of a grid, all of them or a sample.

    Attributes
    ----------
    poses, sampled
        Scene cells of the grid, and how many of them were looked at.
    tilt_deg, viewing_angle_deg, range_m
        (n,) of each: angle to the image plane, angle to the line of sight, distance of the centre.
    depth_m
        (n,) of the centre, along the optical axis.
    behind, averted, outside, cut
        (n,) whether a corner is behind the camera; the marker is seen from behind or edge on; it
        lies outside the frame; a corner of the black square does. Each without those before.
    """

    poses: int
    sampled: int
    tilt_deg: Floats
    viewing_angle_deg: Floats
    range_m: Floats
    depth_m: Floats
    behind: Masks
    averted: Masks
    outside: Masks
    cut: Masks

    def line(self) -> str:
        """Return the poses in one line."""
        parts = [
            f"tilt {_extent(self.tilt_deg, '.4g')}°",
            f"viewing angle {_extent(self.viewing_angle_deg, '.4g')}°",
            f"{_extent(self.range_m, '.4g')} m away",
        ]
        sample = "" if self.sampled == self.poses else f" ({self.sampled:,} poses looked at)"
        return ", ".join(parts) + sample

    def ranges(self) -> dict[str, list[float]]:
        """Return the least and the largest tilt, viewing angle and distance."""
        return {
            name: [float(numbers.min()), float(numbers.max())]
            for name, numbers in (
                ("tilt_deg", self.tilt_deg), ("viewing_angle_deg", self.viewing_angle_deg),
                ("range_m", self.range_m),
            )
        }

    def share(self, chosen: Masks) -> str:
        """Return the share of the poses that are ``chosen``, in words."""
        count = int(chosen.sum())
        if count == self.sampled:
            return "all poses" if self.sampled == self.poses else f"all {count:,} poses looked at"
        roughly = "" if self.sampled == self.poses else "about "
        return f"{roughly}{100 * chosen.mean():.2g} % of the poses"


def pose_facts(pipeline: Pipeline) -> PoseFacts:
    """Return what a pipeline's poses are."""
    indices = _sample([len(axis) for axis in scene_axes(pipeline)])
    count = len(indices[0]) if indices else 1
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count)
    normal, depth = scenes.rotation[:, 2, 2], scenes.translation[:, 2]
    behind = np.asarray(~np.isfinite(scenes.outline_px).all(axis=(1, 2)))
    averted = hidden(scenes) & ~behind
    outside = np.zeros(count, dtype=bool)
    seen = np.flatnonzero(~behind & ~averted)
    outside[seen] = outside_frame(scenes, seen)
    return PoseFacts(
        poses=math.prod(len(axis) for axis in scene_axes(pipeline)),
        sampled=count,
        tilt_deg=np.degrees(np.arctan2(np.hypot(*scenes.rotation[:, :2, 2].T), -normal)),
        viewing_angle_deg=np.degrees(viewing_angle(scenes.rotation, scenes.translation)),
        range_m=np.linalg.norm(scenes.translation, axis=1),
        depth_m=depth,
        behind=behind, averted=averted, outside=outside,
        cut=_cut(scenes) & ~behind & ~averted & ~outside,
    )


def _sample(lengths: Sequence[int]) -> list[NDArray[np.intp]]:
    """Return the indices (n,) along each axis of the cells that are looked at."""
    cells = math.prod(lengths)
    if cells <= MAX_SAMPLE:
        return [index.ravel() for index in np.indices(lengths, dtype=np.intp)]
    ends = itertools.product(*((0, length - 1) if length > 1 else (0,) for length in lengths))
    corners = np.array(list(itertools.islice(ends, MAX_CORNERS)), dtype=np.intp)
    chosen = np.random.default_rng(0)
    anywhere = [chosen.integers(0, length, MAX_SAMPLE - len(corners)) for length in lengths]
    return [
        np.concatenate([corner, other]).astype(np.intp)
        for corner, other in zip(corners.T, anywhere, strict=True)
    ]


def _cut(scenes: Scenes) -> Masks:
    """Return (n,) whether a corner of the black square is outside the frame."""
    corners, limit = scenes.corners_px, scenes.frame[:, None, :] - 0.5
    return np.asarray(((corners < -0.5) | (corners > limit)).any(axis=(1, 2)))


def pose_notes(pipeline: Pipeline, facts: PoseFacts) -> list[str]:
    """Return a line for each property of a pipeline's poses that may surprise."""
    return [
        *_visibility_notes(pipeline, facts), *_angle_notes(pipeline, facts),
        *_distance_notes(pipeline, facts), *_idle_notes(pipeline), *_unit_notes(pipeline),
    ]


def _visibility_notes(pipeline: Pipeline, facts: PoseFacts) -> list[str]:
    lines = []
    world = any(name in pipeline.given for name in WORLD)
    framed = {"frame_x", "frame_y"} & pipeline.given
    target = target_word(pipeline)
    where = "outside the frame of the camera" if world else "outside the frame"
    for chosen, what in (
        (facts.behind, "have a corner behind the camera: not_visible"),
        (facts.averted,
         f"show the {target}'s back or its edge (a viewing angle of 90° or more): not_visible"),
        (facts.outside, f"are {where}: not_visible"
         + ("" if world or framed else f"; frame_x and frame_y place a {target} within it")),
        (facts.cut, "are cut off by the frame's edge"
         + (f"; where the {target} is too large for the frame, frame_x and frame_y put it in the "
            "middle" if framed else "")),
    ):
        if chosen.mean() > MIN_SHARE:
            lines.append(f"{facts.share(chosen)} {what}")
    unseen = facts.behind | facts.averted | facts.outside
    if unseen.all() and len(lines) > 1:
        lines.insert(0, f"{facts.share(unseen)} are not_visible:")
    return lines


def _angle_notes(pipeline: Pipeline, facts: PoseFacts) -> list[str]:
    if pipeline.given.intersection((*WORLD, "view_angle_deg")):
        return []
    shown = ~facts.behind
    tilt, view = facts.tilt_deg[shown], facts.viewing_angle_deg[shown]
    difference = np.abs(view - tilt)
    if difference.max(initial=0) <= APART_DEG:
        return []
    given = "yaw_deg and pitch_deg are" if {"yaw_deg", "pitch_deg"} & pipeline.given else (
        "tilt_deg is"
    )
    line = (
        f"off the optical axis the viewing angle differs from the tilt by up to "
        f"{difference.max():.3g}° (tilt {_extent(tilt, '.3g')}°, viewing angle "
        f"{_extent(view, '.3g')}°): {given} to the image plane, "
        "view_angle_deg is to the line of sight"
    )
    return [line]


def _distance_notes(pipeline: Pipeline, facts: PoseFacts) -> list[str]:
    shown = ~facts.behind
    if pipeline.given.intersection(WORLD) or not shown.any():
        return []
    farther = float((facts.range_m[shown] / facts.depth_m[shown]).max())
    if farther <= FARTHER:
        return []
    name = "side_px" if "side_px" in pipeline.given else "distance_m"
    line = (
        f"{name} counts along the optical axis: off it, the {target_word(pipeline)}'s centre is up "
        f"to {farther:.3g} times as far away"
    )
    return [line]


def _idle_notes(pipeline: Pipeline) -> list[str]:
    """Return a line for an azimuth that is varied without a tilt."""
    varied = "azimuth_deg" in pipeline.distributions or len(pipeline.values_of("azimuth_deg")) > 1
    name = "view_angle_deg" if "view_angle_deg" in pipeline.given else "tilt_deg"
    tilted = name in pipeline.distributions or pipeline.any_value(name, bool)
    if not varied or tilted:
        return []
    return [f"azimuth_deg has no effect: it is the direction of a tilt, and {name} is 0"]


ROUNDED_RAD = 4e-3
"""How far an angle in radians that someone rounded may be from a multiple of 15°."""


def _unit_notes(pipeline: Pipeline) -> list[str]:
    """Return a line for each angle whose values look like radians."""
    lines = []
    for parameter in PARAMETERS.values():
        if parameter.section != "pose" or parameter.unit != "degree":
            continue
        drawn = pipeline.distributions.get(parameter.name)
        values = [drawn.a, drawn.b] if drawn else [
            float(value) for value in pipeline.values_of(parameter.name) if value is not None
        ]
        steps = np.array([value for value in values if value]) / (math.pi / 12)
        close = np.abs(steps - np.round(steps)) * (math.pi / 12) < ROUNDED_RAD
        if len(steps) > 0 and (close & (np.abs(steps) > 0.5) & (np.abs(steps) < 24.5)).all():
            largest = max(values, key=abs)
            lines.append(
                f"{parameter.name} = {largest:g}: in degrees; {largest:g} radians would be "
                f"{math.degrees(largest):.4g}"
            )
    return lines


def _extent(numbers: Floats, form: str) -> str:
    low, high = (format(round(float(end), 9) + 0.0, form) for end in (numbers.min(), numbers.max()))
    return low if low == high else f"{low} to {high}"

