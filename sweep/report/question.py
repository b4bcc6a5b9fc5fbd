"""The question that a report answers: requirements, and the conditions that they are judged at."""

from __future__ import annotations

from dataclasses import dataclass

from sweep.analysis.conditions import SIZES_BESIDE, usual_conditions
from sweep.report.grouping import ANGLES, is_numeric
from sweep.report.report_data import ReportData


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


def course_of(data: ReportData, per: tuple[str, ...] | None = None) -> Course:
    """Return how requirements are followed over conditions: by default the usual ones."""
    axes = {axis.name: axis for axis in data.pipeline.axes}
    per = usual_conditions(data.results) if per is None else per
    conditions = tuple(name for name in per if name not in data.setting_axes)
    ordered = [name for name in conditions
               if name in data.scene_axes and is_numeric(axes[name])]
    ordered.sort(key=lambda name: (
        name != data.size_axis, name not in SIZES_BESIDE, name in ANGLES))
    along = ordered[0] if ordered else None
    angle = next((name for name in ordered[1:] if name in ANGLES), None)
    return Course(along, angle, tuple(
        name for name in conditions if name not in (along, angle)))
