"""The sweeps of the page, and what the model predicts of them.

    python pipelines/open_question/sweeps.py

writes ``predictions.csv``: the predicted rates of the sweeps that were held back. It was written
before these were swept, and is made again from the model alone.
"""  # noqa: INP001  (a folder of a page, not a package)

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import xarray as xr
from bit_reading import predicted_rates, reading_of
from dips import Rates
from quadrilaterals import Surround, upright_corners

import sweep
from sweep.measure.detectors import DetectorSetting
from sweep.measure.flags import DetectionStatus
from sweep.model.marker import dictionary_names, marker_count, module_count, modules

FOLDER = Path(__file__).parent
PREDICTIONS = FOLDER / "predictions.csv"
SENSOR_MM = 4.8
FRAMES = {640: (480, 4.0), 1280: (960, 6.0), 1920: (1440, 8.0)}
"""Height in px and focal length in mm by the width."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep of second_dip.toml: one dictionary and tilt, IDs [first, last), sides in px."""

    dictionary: str
    ids: tuple[int, int]
    sides_px: tuple[float, ...]
    trials: int
    width_px: int = 640
    tilt_deg: float = 0.0
    azimuth_deg: float = 0.0

    @property
    def name(self) -> str:
        """A name for files."""
        short = self.dictionary.removeprefix("DICT_").lower()
        return f"{short}_{self.width_px}_tilt_{self.tilt_deg:g}_{self.ids[0]}_{len(self.sides_px)}"

    @property
    def title(self) -> str:
        """What is swept, as rows of tables name it."""
        dictionary, tilt = self.short_title.split(", ")
        return f"{dictionary}, IDs {self.ids[0]}-{self.ids[1] - 1}, {self.width_px} px, {tilt}"

    @property
    def short_title(self) -> str:
        """Dictionary and tilt."""
        axis = "" if self.tilt_deg == 0 else " about x" if self.azimuth_deg == 0 else " about y"
        return f"{self.dictionary.removeprefix('DICT_')}, {self.tilt_deg:g}°{axis}"

    def settings(self, trials: int | None = None) -> list[str]:
        """Return the settings as ``--set`` takes them, with other trials where they are given."""
        height_px, focal_mm = FRAMES[self.width_px]
        return [
            f"dictionary={self.dictionary}", f"marker_id={{range=[{self.ids[0]},{self.ids[1]}]}}",
            f"side_px={list(self.sides_px)}", f"trial={trials or self.trials}",
            f"width_px={self.width_px}", f"height_px={height_px}", f"focal_length_mm={focal_mm}",
            f"tilt_deg={self.tilt_deg}", f"azimuth_deg={self.azimuth_deg}",
        ]

    def pipeline(self, trials: int | None = None) -> sweep.Pipeline:
        """Return the pipeline."""
        return sweep.Pipeline.from_toml(FOLDER.parent / "second_dip.toml", self.settings(trials))

    def corners(self, side_px: float) -> np.ndarray:
        """Return the corners (4, 2) of the square at a side, around (0, 0)."""
        focal_px = FRAMES[self.width_px][1] * self.width_px / SENSOR_MM
        return upright_corners(side_px, self.tilt_deg, self.azimuth_deg, focal_px)

    def rates(self, rates: np.ndarray) -> Rates:
        """Return rates (S, M) with the sides, areas and IDs of the sweep."""
        sides = np.array(self.sides_px)
        areas = sides**2 * math.cos(math.radians(self.tilt_deg))
        return Rates(sides, areas, np.arange(*self.ids), rates)


def spread(low: float, high: float, step: float) -> tuple[float, ...]:
    """Return sides from ``low`` to ``high``, both inclusive, to 0.01 px."""
    return tuple(np.arange(low, high + step / 2, step).round(2).tolist())


def small(dictionary: str, tilt_deg: float, count: int = 40) -> tuple[float, ...]:
    """Return sides at which the shorter side of the image has 1.2 to 2.4 px a module."""
    across = module_count(dictionary) / math.cos(math.radians(tilt_deg))
    return tuple(np.linspace(1.2 * across, 2.4 * across, count).round(2).tolist())


def held_back(dictionary: str, ids: tuple[int, int], width_px: int) -> tuple[Sweep, ...]:
    """Return the sweeps of a dictionary at 0°, at 45° about x and at 60° about y."""
    return tuple(
        Sweep(dictionary, ids, small(dictionary, tilt), 40, width_px, tilt, azimuth)
        for tilt, azimuth in ((0.0, 0.0), (45.0, 0.0), (60.0, 90.0))
    )


DEVELOPMENT = Sweep("DICT_5X5_50", (0, 50), spread(8.5, 22.0, 0.15), 12)
HELD_BACK = (
    *held_back("DICT_4X4_100", (50, 80), 640),
    *held_back("DICT_6X6_250", (100, 130), 640),
    *held_back("DICT_7X7_250", (60, 90), 1280),
    *held_back("DICT_APRILTAG_36h11", (0, 30), 1280),
)
"""Swept after the model and its predictions were fixed."""
SECOND = tuple(
    Sweep(dictionary, ids, spread(18.8, 21.3, 0.1), trials, width)
    for dictionary, ids, trials, width in (
        ("DICT_5X5_50", (0, 50), 100, 640), ("DICT_5X5_100", (50, 80), 60, 1920),
        ("DICT_APRILTAG_25h9", (0, 35), 100, 1280),
    )
)
"""The middle column and row at W = 19, ID by ID."""


def every_dictionary() -> list[Sweep]:
    """Return a sweep of every predefined dictionary's last ten IDs, upright and frontal.

    OpenCV has two spellings of some names.
    """
    names = {getattr(cv2.aruco, name): name for name in dictionary_names()}
    return [
        Sweep(name, (marker_count(name) - 10, marker_count(name)), small(name, 0.0, 30), 20)
        for name in sorted(names.values())
    ]


def predicted(
    one: Sweep, setting: DetectorSetting | None = None, surround: Surround | None = None
) -> Rates:
    """Return the model's rates of a sweep: from bits, projected corners and the frame's size."""
    height_px, _ = FRAMES[one.width_px]
    reading = reading_of(one.dictionary, one.width_px, height_px, setting or DetectorSetting())
    bits = np.array([modules(one.dictionary, i) for i in range(*one.ids)])
    return one.rates(np.array([
        predicted_rates(bits, one.corners(side), reading, surround) for side in one.sides_px
    ]))


def measured(one: Sweep, results: xr.Dataset) -> Rates:
    """Return the detection rates of a sweep."""
    found = (results["detection"] == DetectionStatus.detected).mean("trial")
    return one.rates(found.transpose("side_px", "marker_id").to_numpy())


def main() -> None:
    """Write the predictions of the sweeps that were held back."""
    with PREDICTIONS.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(["sweep", "side_px", "area_px2", "predicted_rate"])
        for one in HELD_BACK:
            rates = predicted(one)
            for side, area, rate in zip(rates.sides_px, rates.areas_px2, rates.mean, strict=True):
                lines.writerow([one.title, f"{side:.2f}", f"{area:.1f}", f"{rate:.3f}"])


def written_down() -> dict[str, np.ndarray]:
    """Return the predicted rates (S,) of each sweep that was held back, by its title."""
    with PREDICTIONS.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {
        one.title: np.array([float(row["predicted_rate"]) for row in rows
                             if row["sweep"] == one.title])
        for one in HELD_BACK
    }


if __name__ == "__main__":
    main()
