"""The detection limit: the smallest size at which the marker is detected reliably."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sweep.analysis import detection_limit
from sweep.analysis.detection_limits import Limit
from sweep.errors import SweepError
from sweep.plan.parameters import Stage
from sweep.report.formatting import coordinate, number
from sweep.report.grouping import ANGLES
from sweep.report.report_data import ReportData
from sweep.report.table import Table
from sweep.report.tile import Tile

RELIABLE_RATE = 0.9
"""The detection rate that counts as reliable."""

MAX_LISTED = 3
"""Limits that the paragraph lists; more stand in a table."""

NEVER = "never"

CRITERION = f"detected in at least {100 * RELIABLE_RATE:.0f} % of poses down to this size"


class SizeLimit(NamedTuple):
    """The limit of one condition, as text: side of the marker in the image, and its distance."""

    condition: str
    side: str
    distance: str


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits by tilt and dictionary, with the first ``settings`` of the detector."""

    limits: tuple[SizeLimit, ...] = ()
    settings: str = ""


def limits_of(data: ReportData) -> Limits:
    """Return the detection limits with the first setting of the detector.

    Empty if the marker's size is no axis, or the side in the image is not known.
    """
    if data.size_axis is None:
        return Limits()
    axes = data.pipeline.axes_of(Stage.detection)
    first = data.results.isel({axis.name: 0 for axis in axes})
    settings = ", ".join(
        f"{axis.name} {coordinate(first[axis.name].item())}" for axis in axes if len(axis) > 1
    )
    per = (data.angle_axis,) if data.angle_axis else ()
    try:
        lazy = detection_limit(first, rate=RELIABLE_RATE, per=per)
    except SweepError:  # the side differs within what is pooled, or is not known
        return Limits()
    computed = data.once("detection_limit", lambda: lazy)
    dims = [str(dim) for dim in computed["side_px"].dims]
    limits = []
    for index in np.ndindex(*(computed.sizes[name] for name in dims)):
        cell = computed.isel(dict(zip(dims, index, strict=True)))
        values = {name: cell[name].item() for name in dims}
        condition = ", ".join(
            f"{ANGLES[name]} {coordinate(value)}\u00b0" if name in ANGLES else str(value)
            for name, value in values.items()
        )
        limit = int(cell["limit"])
        if limit == Limit.never:
            limits.append(SizeLimit(condition, NEVER, ""))
            continue
        at_most = "\u2264 " if limit == Limit.always else ""
        distance = ""
        if "distance_m" in cell.variables and math.isfinite(float(cell["distance_m"])):
            distance = f"{number(float(cell['distance_m']))} m"
        side = f"{at_most}{number(float(cell['side_px']))} px"
        limits.append(SizeLimit(condition, side, distance))
    return Limits(tuple(limits), f"with {settings}" if settings else "")


def limits_sentence(detected: Limits) -> str:
    """Return the limits as a sentence: each, or the first and the last of many."""
    limits = detected.limits
    if not limits:
        return ""
    start = f"{detected.settings}, " if detected.settings else ""
    share = f"at least {100 * RELIABLE_RATE:.0f} %"
    if all(limit.side == NEVER for limit in limits):
        return _capitalised(f"{start}the detection rate reaches {share} at no size.")
    listed = [
        f"{f'{condition}: ' if condition else ''}{side}{f' ({distance})' if distance else ''}"
        for condition, side, distance in limits
    ]
    text = "; ".join(listed) if len(listed) <= MAX_LISTED else (
        f"{listed[0]}, to {listed[-1]} (all are in the table below)")
    return _capitalised(f"{start}{CRITERION}: {text}.")


def limits_tile(detected: Limits) -> Sequence[Tile]:
    """Return a tile with the first limit, if there are limits."""
    return [
        Tile(f"{100 * RELIABLE_RATE:.0f} % detected down to a side of", limit.side,
             ", ".join(filter(None, (limit.distance, limit.condition, detected.settings))))
        for limit in detected.limits[:1]
    ]


def limits_table(detected: Limits) -> Sequence[Table]:
    """Return a table of the limits, if there are more than the sentence lists."""
    limits = detected.limits
    if len(limits) <= MAX_LISTED:
        return []
    columns = 3 if any(limit.distance for limit in limits) else 2
    settings = f", {detected.settings}" if detected.settings else ""
    return [Table(
        f"{_capitalised(CRITERION)}{settings}",
        ["condition", "side", "distance"][:columns], [list(limit)[:columns] for limit in limits],
    )]


def _capitalised(text: str) -> str:
    return text[0].upper() + text[1:]
