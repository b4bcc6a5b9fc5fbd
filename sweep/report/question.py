"""The question that a report answers: requirements, and the conditions that they are judged at."""

from __future__ import annotations

from dataclasses import dataclass

from sweep.report.grouping import ANGLES, IDS, is_numeric
from sweep.report.report_data import ReportData

SIZES_BESIDE = ("size_m", "hfov_deg", "focal_length_mm", "fx_px", "width_px")
"""Axes along which the size in the image changes, too."""


@dataclass(frozen=True)
class Course:
    """How requirements are followed over the grid.

    Attributes
    ----------
    along
        The axis along which a limit is looked for; None if there is none.
    angle
        The axis of angles up to each of which there is a limit of its own, or None.
    at_all
        Axes at all of whose values the requirements must hold.
    """

    along: str | None
    angle: str | None
    at_all: tuple[str, ...]


def course_of(data: ReportData, per: tuple[str, ...] = ()) -> Course:
    """Return how requirements are followed over the conditions ``per``.

    By default these are the axis of sizes, or the first other one of numbers, and that of angles.
    """
    axes = {axis.name: axis for axis in data.pipeline.axes}
    if not per:
        sizes = [data.size_axis, *(name for name in SIZES_BESIDE if data.length(name) > 1), *(
            name for name in data.scene_axes if is_numeric(axes[name])
            and name not in ANGLES and name != IDS)]
        per = tuple(name for name in (next(filter(None, sizes), None), data.angle_axis) if name)
    conditions = tuple(name for name in per if name not in data.setting_axes)
    ordered = [name for name in conditions
               if name in data.scene_axes and is_numeric(axes[name])]
    ordered.sort(key=lambda name: (
        name != data.size_axis, name not in SIZES_BESIDE, name in ANGLES))
    along = ordered[0] if ordered else None
    angle = next((name for name in ordered[1:] if name in ANGLES), None)
    return Course(along, angle, tuple(
        name for name in conditions if name not in (along, angle)))
