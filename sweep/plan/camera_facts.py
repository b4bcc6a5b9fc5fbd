"""What a pipeline's camera is: focal lengths, fields of view, the marker's side in pixels."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.model.camera import (
    VIEW_PARAMETERS,
    are_square,
    canonical_distortion,
    field_of_view_deg,
    intrinsics,
)
from sweep.model.lens import fold_radius
from sweep.model.marker import module_count
from sweep.plan.beliefs import belief_notes
from sweep.plan.boards import relative_sizes, shows_boards
from sweep.plan.camera_values import FIELDS_OF_VIEW
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes, scene_values
from sweep.typing import Floats

Range = tuple[float, float]
"""The least and the largest value on the grid."""

NORMAL_SDS = 3.0
"""Standard deviations from the mean at which the ends of a normal distribution are stated."""


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """The camera of a grid; each quantity has its least and its largest value.

    Attributes
    ----------
    width_px, height_px, fx_px, fy_px, cx_px, cy_px
        Frame, focal lengths and principal point.
    hfov_deg, vfov_deg
        Angle between the frame's edges, without lens distortion: 2 atan(width / (2 fx)).
    aspect
        fy / fx: the width of a pixel over its height.
    off_centre_x, off_centre_y
        Principal point minus the frame's centre, as a share of its width and height.
    square
        Whether the pixels are square everywhere on the grid.
    side_px
        Side of the black square parallel to the image plane, at the farthest and the nearest
        pose; None if the distance is not one of the pipeline's numbers. Of boards the sides of the
        smallest and the largest marker.
    boards
        Whether scenes show boards.
    """

    width_px: Range
    height_px: Range
    fx_px: Range
    fy_px: Range
    cx_px: Range
    cy_px: Range
    hfov_deg: Range
    vfov_deg: Range
    aspect: Range
    off_centre_x: Range
    off_centre_y: Range
    square: bool
    side_px: Range | None
    boards: bool

    def line(self) -> str:
        """Return the camera in one line."""
        focal = f"fx = fy = {_text(self.fx_px)} px"
        if not self.square:
            focal = (
                f"fx = {_text(self.fx_px)} px, fy = {_text(self.fy_px)} px "
                f"(pixels are not square: fy/fx = {_text(self.aspect, 4)})"
            )
        parts = [
            f"{_text(self.width_px)} x {_text(self.height_px)} px", focal,
            f"HFOV {_text(self.hfov_deg, 4)}°", f"VFOV {_text(self.vfov_deg, 4)}°",
        ]
        if self.side_px is not None:
            far, near = self.side_px
            parts.append(
                f"the markers have sides of {_text(self.side_px, 4)} px" if self.boards else
                f"the marker's side is {far:.4g} px" if far == near else
                f"the marker's side is {near:.4g} px at the nearest pose, {far:.4g} px at the "
                "farthest"
            )
        return ", ".join(parts)

    def attributes(self) -> dict[str, Any]:
        """Return the dataset's attributes: a number, or the least and the largest one."""
        named = {
            "camera_fx_px": self.fx_px, "camera_fy_px": self.fy_px,
            "camera_hfov_deg": self.hfov_deg, "camera_vfov_deg": self.vfov_deg,
        }
        attributes: dict[str, Any] = {
            name: low if low == high else [low, high] for name, (low, high) in named.items()
        }
        if self.side_px is not None:
            far, near = self.side_px
            attributes |= {"nearest_side_px": near, "farthest_side_px": far}
        return attributes


def _text(ends: Range, digits: int = 6) -> str:
    low, high = (f"{end:.{digits}g}" for end in ends)
    return low if low == high else f"{low} to {high}"


MAX_ROWS = 10**6
"""The most rows of axes of parameters that go together whose cameras are computed."""


def camera_facts(pipeline: Pipeline) -> CameraFacts:
    """Return what a pipeline's camera is.

    Every quantity is monotonic in each parameter, so that the ends of the axes have its ends; of
    parameters that go together every row is looked at.
    """
    together = [axis for axis in pipeline.axes
                if axis.zipped and axis.columns.keys() & set(VIEW_PARAMETERS)]
    lengths = [len(axis) for axis in together]
    if math.prod(lengths) > MAX_ROWS:
        together, lengths = [], []  # the ends of each column are bounds
    rows = [index.ravel() for index in np.indices(lengths)]
    zipped = {
        name: np.asarray(column)[index]
        for axis, index in zip(together, rows, strict=True)
        for name, column in axis.columns.items() if name in VIEW_PARAMETERS
    }
    chosen = [
        [zipped[name]] if name in zipped else dict.fromkeys(_ends(pipeline, name) or (None,))
        for name in VIEW_PARAMETERS
    ]
    found: dict[str, list[Floats]] = {}
    for values in itertools.product(*chosen):
        fx, fy, cx, cy = intrinsics(*values)
        width, height = values[:2]
        for name, numbers in {
            "width_px": width, "height_px": height, "fx_px": fx, "fy_px": fy, "cx_px": cx,
            "cy_px": cy, "hfov_deg": field_of_view_deg(width, fx),
            "vfov_deg": field_of_view_deg(height, fy), "aspect": fy / fx,
            "off_centre_x": (cx - (width - 1) / 2) / width,
            "off_centre_y": (cy - (height - 1) / 2) / height,
        }.items():
            found.setdefault(name, []).append(np.asarray(numbers, dtype=np.float64))
    ranges = {
        name: (float(min(map(np.min, parts))), float(max(map(np.max, parts))))
        for name, parts in found.items()
    }
    square = all(
        np.all(are_square(fx, fy)) for fx, fy in zip(found["fx_px"], found["fy_px"], strict=True)
    )
    return CameraFacts(square=square, side_px=_side(pipeline, ranges["fx_px"]),
                       boards=shows_boards(pipeline), **ranges)


def _ends(pipeline: Pipeline, name: str) -> tuple[Any, Any] | None:
    """Return the least and the largest value of a parameter; None if it is not given."""
    if name in pipeline.distributions:
        drawn = pipeline.distributions[name]
        if drawn.kind == "uniform":
            return drawn.a, drawn.b
        return drawn.a - NORMAL_SDS * drawn.b, drawn.a + NORMAL_SDS * drawn.b
    values = pipeline.values_of(name)
    if not len(values) or values[0] is None:
        return None
    return min(values), max(values)


def _side(pipeline: Pipeline, fx: Range) -> Range | None:
    """Return the least and the largest side of a marker in pixels."""
    sides, (least, largest) = _side_of_size_m(pipeline, fx), relative_sizes(pipeline)
    return sides and (sides[0] * least, sides[1] * largest)


def _side_of_size_m(pipeline: Pipeline, fx: Range) -> Range | None:
    """Return the least and the largest side in pixels, fx · size / distance."""
    if (sides := _ends(pipeline, "side_px")) is not None:
        return sides
    size, distance = _ends(pipeline, "size_m"), _ends(pipeline, "distance_m")
    if size is None or distance is None:
        return _side_of_cells(pipeline)
    if not distance[0] > 0:
        return None
    return fx[0] * size[0] / distance[1], fx[1] * size[1] / distance[0]


MAX_CELLS = 10_000
"""Poses whose distances are computed where they are not numbers of the pipeline."""


def _side_of_cells(pipeline: Pipeline) -> Range | None:
    """Return the least and the largest side in pixels of a small grid's poses before the camera."""
    lengths = [len(axis) for axis in scene_axes(pipeline)]
    count = math.prod(lengths)
    if count > MAX_CELLS:
        return None
    values = scene_values(pipeline, [index.ravel() for index in np.indices(lengths, dtype=np.intp)])
    fx = intrinsics(*(values[name].values for name in VIEW_PARAMETERS))[0]
    distance = values["distance_m"].broadcast(count)
    before = distance > 0
    sides = np.broadcast_to(fx, count)[before] * values["size_m"].broadcast(count)[before]
    sides = sides / distance[before]
    return (float(sides.min()), float(sides.max())) if len(sides) else None


OFF_CENTRE = 0.15
"""Distance of the principal point from the frame's centre, as a share of its side, that is told."""

WIDE_DEG = 150.0
"""Horizontal field of view above which it is told; lenses without fisheye reach about 130."""

RADIANS = (0.2, math.pi)
"""Fields of view between these look like radians: of 12 to 180 degrees."""

POLE = 1e-9
"""Denominator of the radial distortion at a fold below which it is a pole."""

NOT_SQUARE = 0.01
"""Difference of fy/fx from 1 that is told; calibrations of square pixels differ by less."""


def notes(pipeline: Pipeline) -> list[str]:
    """Return a line for each property of the camera, or of beliefs about it, that may surprise."""
    facts = camera_facts(pipeline)
    return [
        *_focal_notes(pipeline, facts), *_angle_notes(pipeline), *_centre_notes(facts),
        *_fold_notes(pipeline, facts), *_side_notes(pipeline, facts),
        *belief_notes(pipeline.given, pipeline.fixed, pipeline.values_of("believed")),
    ]


def _focal_notes(pipeline: Pipeline, facts: CameraFacts) -> list[str]:
    lines = []
    if max(abs(ratio - 1) for ratio in facts.aspect) > NOT_SQUARE:
        lines.append(
            f"pixels are not square: fy/fx = {_text(facts.aspect, 4)}; a single side "
            "of the sensor, or fx_px alone, makes them square"
        )
    if facts.hfov_deg[1] > WIDE_DEG:
        lines.append(
            f"HFOV {_text(facts.hfov_deg, 4)}°: hardly any pinhole camera is as wide; is a focal "
            "length in another unit?"
        )
    if _varies(pipeline, "width_px") and pipeline.fixed.get("fx_px") is not None:
        lines.append(
            "fx_px is fixed while width_px varies: HFOV goes from "
            f"{_text(facts.hfov_deg, 4)}°; hfov_deg in place of fx_px keeps it"
        )
    return lines


def _angle_notes(pipeline: Pipeline) -> list[str]:
    """Return a line for a field of view that looks like radians."""
    return [
        f"{name} = {_text(ends)}: in degrees; {ends[1]:g} radians would be "
        f"{math.degrees(ends[1]):.4g}"
        for name in FIELDS_OF_VIEW
        if (ends := _ends(pipeline, name)) and ends[0] > RADIANS[0] and ends[1] < RADIANS[1]
    ]


def _side_notes(pipeline: Pipeline, facts: CameraFacts) -> list[str]:
    """Return a line if no marker of the grid is of a size that can be detected."""
    if facts.side_px is None:
        return []
    far, near = facts.side_px
    units = (
        "" if "side_px" in pipeline.given
        else "; are size_m and the distances in metres?" if "size_m" in pipeline.given
        else f"; size_m is not given: {pipeline.fixed['size_m']:g} m"
    )
    line = ""
    if near < min(map(module_count, pipeline.values_of("dictionary"))):
        line = f"at most {near:.4g} px, less than a pixel a module: too small to be read"
    elif far > max(facts.width_px[1], facts.height_px[1]):
        line = f"at least {far:.4g} px, more than the frame's"
    whose = "the markers' sides are" if facts.boards else "the marker's side is"
    return [f"{whose} {line}{units}"] if line else []


def _centre_notes(facts: CameraFacts) -> list[str]:
    lines = []
    frame = f"{_text(facts.width_px)} x {_text(facts.height_px)} px"
    for name, ends, shares in (
        ("cx_px", facts.cx_px, facts.off_centre_x), ("cy_px", facts.cy_px, facts.off_centre_y),
    ):
        off = max(map(abs, shares))
        if off > 0.5:
            lines.append(f"{name} = {_text(ends)}: outside the frame of {frame}")
        elif off > OFF_CENTRE:
            lines.append(
                f"{name} = {_text(ends)}: far from the centre of the frame of {frame}; is it that "
                "of another frame size?"
            )
    return lines


def _fold_notes(pipeline: Pipeline, facts: CameraFacts) -> list[str]:
    """Return a line if the radial distortion of the only lens stops growing within the frame."""
    lens = canonical_distortion(pipeline.fixed.get("distortion", ()))
    ends = (facts.width_px, facts.height_px, facts.fx_px, facts.fy_px, facts.cx_px, facts.cy_px)
    if not lens or any(low != high for low, high in ends) or not math.isfinite(fold_radius(lens)):
        return []
    width, height, fx, fy, cx, cy = (low for low, _ in ends)
    radius = fold_radius(lens)
    k1, k2, _, _, k3, k4, k5, k6 = (*lens, *[0.0] * 8)[:8]
    s = radius**2
    denominator = 1 + s * (k4 + s * (k5 + s * k6))
    if denominator <= POLE:
        return []
    fold = radius * (1 + s * (k1 + s * (k2 + s * k3))) / denominator
    corner = math.hypot(
        max(cx + 0.5, width - 0.5 - cx) / fx, max(cy + 0.5, height - 0.5 - cy) / fy
    )
    if fold >= corner:
        return []
    where = f"{fold * fx:.0f} px from the principal point, within the frame"
    return [
        f"the lens folds {where} (corner: {corner * fx:.0f} px): poses beyond are not_modelled"
    ]


def _varies(pipeline: Pipeline, name: str) -> bool:
    axis = pipeline.axis_of(name)
    return axis is not None and len(axis) > 1
