"""Values of effects that must fit one another, or the frame."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from sweep.model.demosaic import MIN_FRAME_PX
from sweep.model.tone import MAX_LEVEL
from sweep.plan.reader import Reading


def noise_tables_ascend(reading: Reading) -> None:
    """Demand noise tables whose levels ascend on the scale, with deviations of at least 0."""
    for table in reading.values("noise_table"):
        if not _is_noise_table(table):
            reading.fault(
                "scene.noise_table", list(table), f"level, standard deviation, level, standard "
                f"deviation, ...: levels that ascend from 0 to {MAX_LEVEL:g}, deviations of at "
                "least 0",
            )


def _is_noise_table(table: Sequence[float]) -> bool:
    levels, deviations = table[::2], table[1::2]
    return (
        all(a < b for a, b in itertools.pairwise(levels))
        and all(0 <= level <= MAX_LEVEL for level in levels)
        and all(0 <= deviation <= 1e6 for deviation in deviations)
    )


def mosaics_have_room(reading: Reading) -> None:
    """Demand frames that can be demosaiced."""
    if all(value == "none" for value in reading.values("bayer")):
        return
    for name in ("width_px", "height_px"):
        if any(side < MIN_FRAME_PX for side in reading.values(name)):
            reading.fault(
                f"camera.{name}", reading.written(name),
                f"at least {MIN_FRAME_PX}, for bayer to be demosaiced",
            )
