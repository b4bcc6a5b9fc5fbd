"""The page "The paper's open question": its sweeps, predictions, tables and figures.

    python pipelines/open_question/make.py [--only NAME ...] [--trials N] [--workers N]

Run it in the repository's root. Sweeps go to runs/; what is finished there is not computed again.
Tables are printed as Markdown, figures are written beside this file.
"""  # noqa: INP001  (a folder of a page, not a package)

# ruff: noqa: T201

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import xarray as xr
from dips import Rates, dips, half_read, pairs

import sweep
from sweep.analysis import compare
from sweep.measure.bit_reading import STAYS_LOST, lone_cells, predicted_rate, reading_of
from sweep.measure.detector import DetectorSetting
from sweep.measure.flags import DetectionStatus
from sweep.model.marker import module_count, modules, opencv_dictionary

FOLDER = Path(__file__).parent
PIPELINES = FOLDER.parent
SINGLE_READING = 1.0
"""``stays_lost`` of the model's first version, which knows one quadrilateral only."""
FIRST_VERSION = "held back from the first version"


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep of second_dip.toml: settings as ``--set`` takes them, and what is said of it."""

    name: str
    settings: tuple[str, ...] = ()
    said: str = "held back"

    def pipeline(self, trials: int | None = None) -> sweep.Pipeline:
        """Return the pipeline, with other trials where they are given."""
        more = () if trials is None else (f"trial={trials}",)
        return sweep.Pipeline.from_toml(PIPELINES / "second_dip.toml", (*self.settings, *more))


def _sweep(
    name: str, ids: tuple[int, int], sides: tuple[float, float], trials: int, width_px: int,
    said: str = "held back",
) -> Sweep:
    height_px, focal_mm = {640: (480, 4.0), 1280: (960, 6.0), 1920: (1440, 8.0)}[width_px]
    return Sweep(f"{name.removeprefix('DICT_').lower()}_{width_px}", (
        f"dictionary={name}",
        f"marker_id={{range=[{ids[0]},{ids[1]}]}}",
        f"side_px={{arange=[{sides[0]},{sides[1]},0.1]}}",
        f"trial={trials}", f"width_px={width_px}", f"height_px={height_px}",
        f"focal_length_mm={focal_mm}",
    ), said)


DEVELOPMENT = Sweep("5x5_50_640", said="development")
HELD_BACK = (
    _sweep("DICT_5X5_100", (50, 80), (15.7, 21.3), 60, 1920),
    _sweep("DICT_APRILTAG_25h9", (0, 35), (15.3, 21.5), 100, 1280),
)
"""Swept after the model and its predictions were fixed. Dictionary, IDs, sides in px, trials."""

SWEEPS = (
    DEVELOPMENT,
    _sweep("DICT_5X5_50", (0, 10), (15.3, 21.5), 100, 1280, "development's markers"),
    *HELD_BACK,
    _sweep("DICT_7X7_50", (0, 50), (19.4, 27.4), 100, 1920, FIRST_VERSION),
    _sweep("DICT_6X6_250", (0, 25), (16.6, 26.6), 40, 640, FIRST_VERSION),
    _sweep("DICT_4X4_50", (0, 26), (12.4, 30.1), 40, 1280, FIRST_VERSION),
)
"""4x4 and 6x6 with half of the IDs and 40 trials: no dip is expected that would need more."""

CHANGES = {
    "perspectiveRemovePixelPerCell": (4, 2, 3, 5, 6, 7, 8, 10, 16),
    "perspectiveRemoveIgnoredMarginPerCell": (0.13, 0.0, 0.25, 0.4),
    "errorCorrectionRate": (0.6, 0.0, 1.0),
    "validBitIdThreshold": (0.49, 0.45, 0.5),
    "maxErroneousBitsInBorderRate": (0.35, 0.0, 1.0),
    "cornerRefinementMethod": ("none", "subpix"),
    "adaptiveThreshWinSizeMax": (23, 3),
    "minGroupDistance": (0.21, 0.6),
    "renderer": ("warp", "exact"),
    "roll_deg": (0, 1, 2, 5),
    "tilt_deg": (0, 5, 10),
    "quiet_zone_modules": (1.0, 4.0),
    "background": (0, 255),
}
"""What is changed, one at a time: the default, then others."""

READ_BY_MODEL = (
    "perspectiveRemovePixelPerCell", "perspectiveRemoveIgnoredMarginPerCell",
    "errorCorrectionRate", "maxErroneousBitsInBorderRate",
)
ONE_QUADRILATERAL = (("adaptiveThreshWinSizeMax", 3), ("minGroupDistance", 0.6))
"""Settings that take the further quadrilaterals away."""

DIPS_PX = ((15.7, 16.5), (16.7, 17.7), (18.9, 21.0))
"""Sides over which the settings' losses are averaged, for each dip."""


def swept(
    name: str, pipeline: sweep.Pipeline, trials: int | None, workers: int | None
) -> xr.Dataset:
    """Return a pipeline's results from its store in runs/, which is completed if need be."""
    store = f"runs/{name}.zarr" if trials is None else f"runs/{name}_trials_{trials}.zarr"
    begun = time.perf_counter()
    results = sweep.run(pipeline, store=store, workers=workers)
    print(f"{store}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
    return results.assign(detection=results["detection"].compute())


def measured(results: xr.Dataset, dictionary: str) -> Rates:
    """Return the detection rates of a sweep."""
    found = (results["detection"] == DetectionStatus.detected).mean("trial")
    return Rates(
        results["side_px"].to_numpy().round(1), results["marker_id"].to_numpy(),
        found.transpose("side_px", "marker_id").to_numpy(), module_count(dictionary),
    )


def predicted(
    pipeline: sweep.Pipeline, setting: DetectorSetting | None = None,
    stays_lost: float = STAYS_LOST,
) -> Rates:
    """Return the model's rates of a sweep: from the dictionary and the frame's size alone."""
    [dictionary], [width], [height] = (
        pipeline.values_of(name) for name in ("dictionary", "width_px", "height_px")
    )
    reading = reading_of(dictionary, width, height, setting or DetectorSetting())
    ids = np.array(pipeline.values_of("marker_id"))
    sides = np.array(pipeline.values_of("side_px")).round(1)
    bits = [modules(dictionary, int(marker_id)) for marker_id in ids]
    rates = [
        [predicted_rate(each, float(side), reading, stays_lost=stays_lost) for each in bits]
        for side in sides
    ]
    return Rates(sides, ids, np.array(rates), module_count(dictionary))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table."""
    for row in (header, ["---"] * len(header), *rows):
        print("| " + " | ".join(row) + " |")
    print()


def title(pipeline: sweep.Pipeline) -> str:
    """Return what is swept, as rows of tables name it."""
    [dictionary], [width] = (pipeline.values_of(name) for name in ("dictionary", "width_px"))
    ids = pipeline.values_of("marker_id")
    return f"{dictionary.removeprefix('DICT_')}, IDs {ids[0]}-{ids[-1]}, {width} px"


def dictionaries(trials: int | None, workers: int | None) -> None:
    """Print the dips of every dictionary, what the model says of them, and the rule of the IDs."""
    shown, flags, check, first, rule = [], [], [], [], []
    for one in SWEEPS:
        pipeline = one.pipeline(trials)
        [dictionary] = pipeline.values_of("dictionary")
        name = "second_dip" if one is DEVELOPMENT else f"second_dip_{one.name}"
        results = swept(name, pipeline, trials, workers)
        truth, model = measured(results, dictionary), predicted(pipeline)
        what, count = title(pipeline), len(truth.ids)
        shown.append((what, truth, model))
        read = results["detection"].sel(side_px=slice(2.1 * truth.modules - 1e-9, None))
        counts = {flag: int((read == flag).sum()) for flag in DetectionStatus}
        flags.append([what, f"{read.size:,}", *(f"{counts[flag]:,}" for flag in (
            DetectionStatus.rejected, DetectionStatus.no_candidate, DetectionStatus.wrong_id))])
        found = list(pairs(model, truth))
        check += [[f"{what}: {one.said}", *pair.cells(count)] for pair in found] or [
            [f"{what}: {one.said}", "none / none", *["-"] * 5]]
        if one is DEVELOPMENT or one.said == FIRST_VERSION:
            once = predicted(pipeline, stays_lost=SINGLE_READING)
            first += [[what, *pair.cells(count)] for pair in pairs(once, truth)]
        corrected, named = ruled(dictionary, truth.ids)
        rule += [[what, str(corrected), str(len(named)), f"{len(dip.ids)} of {count}",
                  str(len(named ^ dip.ids))]
                 for dip in dips(truth) if truth.modules == 7 and dip.low_px > 19]
    print("Lost poses, sides from 2.1 px a module:\n")
    table(["swept", "poses", "rejected", "no_candidate", "wrong_id"], flags)
    heads = ["sides, px", "area, px²", "off", "IDs", "IDs that differ", "lowest rate"]
    print("Dips, predicted / measured:\n")
    table(["swept", *heads], check)
    print("The same with the model's first version, without the fitted number:\n")
    table(["swept", *heads], first)
    print("More lone cells in the middle column or row than are corrected, against the second dip "
          "as measured:\n")
    table(["swept", "corrected bits", "IDs by the rule", "IDs measured", "differ"], rule)
    from figures import draw_dictionaries, draw_second_dip  # noqa: PLC0415  (Matplotlib is slow)

    what, truth, model = shown[0]
    draw_second_dip(FOLDER / "second_dip.png", truth, model, ruled("DICT_5X5_50", truth.ids)[1])
    draw_dictionaries(FOLDER / "dictionaries.png", shown[1:])


def ruled(dictionary: str, ids: np.ndarray) -> tuple[int, frozenset[int]]:
    """Return how many bits are corrected, and the IDs that the rule of lone cells names."""
    corrected = reading_of(dictionary, 1, 1, DetectorSetting()).corrected_bits
    lone = {int(i): lone_cells(modules(dictionary, int(i))) for i in ids}
    return corrected, frozenset(i for i, count in lone.items() if count > corrected)


def closed_form(_trials: int | None, _workers: int | None) -> None:
    """Print where cells read half of their neighbours, whatever the bits are."""
    rows = []
    for dictionary in ("DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_50", "DICT_7X7_50"):
        n = module_count(dictionary)
        found = half_read(n, reading_of(dictionary, 640, 480, DetectorSetting()))
        rows += [[str(n), str(cell), f"{low:.2f}-{high:.2f}", f"{low**2:.0f}-{high**2:.0f}"]
                 for cell, (low, high) in found.items()] or [[str(n), "none", "-", "-"]]
    print("Cells that read half of their neighbours, by the modules n (the others mirror them):\n")
    table(["n", "cell", "sides, px", "area, px²"], rows)


def settings(trials: int | None, workers: int | None) -> None:
    """Print what one setting changed at a time does to the three dips, and at which p-value."""
    rows = []
    for name, values in CHANGES.items():
        written = ",".join(f'"{v}"' if isinstance(v, str) else str(v) for v in values)
        more = [f"trial={trials}"] if trials is not None else []
        # The last of two that set the same counts.
        pipeline = sweep.Pipeline.from_toml(PIPELINES / "second_dip_settings.toml", [
            "perspectiveRemovePixelPerCell=4", f"{name}=[{written}]", *more])
        results = swept(f"second_dip_settings_{name}", pipeline, trials, workers)
        rows += [setting_row(name, value, values[0], results, pipeline) for value in values]
    print("Loss in % at the three dips and at the other sides of 15.2-21.8 px (the model's in "
          "brackets), poses with a wrong ID, McNemar's p against the default:\n")
    table(["changed", "value", "257 px²", "292 px²", "391 px²", "elsewhere", "wrong ID", "p"],
          rows)


def setting_row(
    name: str, value: object, default: object, results: xr.Dataset, pipeline: sweep.Pipeline
) -> list[str]:
    """Return a row of the table of settings."""
    one = results.sel({name: value})
    sides = one["side_px"].to_numpy()
    lost = (one["detection"] != DetectionStatus.detected).mean(["marker_id", "trial"]).to_numpy()
    detecting = name in {field.name for field in dataclasses.fields(DetectorSetting)}
    model = None
    if name in READ_BY_MODEL:
        model = predicted(pipeline, DetectorSetting(**{name: value}))
    elif (name, value) in ONE_QUADRILATERAL:
        model = predicted(pipeline, stays_lost=SINGLE_READING)
    rest = np.ones(len(sides), dtype=bool)
    cells = []
    for low, high in DIPS_PX:
        within = (sides > low - 1e-6) & (sides < high + 1e-6)
        rest &= ~within
        cells.append(within)
    cells.append(rest)
    losses = [
        f"{100 * lost[within].mean():.1f}"
        + ("" if model is None else f" ({100 * (1 - model.rates[within]).mean():.1f})")
        for within in cells
    ]
    wrong = int((one["detection"] == DetectionStatus.wrong_id).sum())
    p_value = "-"
    if detecting and value != default:
        p = float(compare(results.sel({name: default}), one)["detection_p_value"])
        p_value = f"{p:.2g}" if p >= 1e-6 else "<1e-6"
    return [f"`{name}`", str(value), *losses, f"{wrong:,} of {one['detection'].size:,}", p_value]


def costs(_trials: int | None, _workers: int | None) -> None:
    """Print what the remedies cost: false markers and CPU time in frames of clutter."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    frames = [clutter(rng) for _ in range(60)]
    rows = []
    for name, value in (
        ("perspectiveRemovePixelPerCell", 4), ("perspectiveRemovePixelPerCell", 8),
        ("perspectiveRemovePixelPerCell", 16), ("perspectiveRemoveIgnoredMarginPerCell", 0.25),
        ("errorCorrectionRate", 1.0), ("validBitIdThreshold", 0.5),
    ):
        parameters = cv2.aruco.DetectorParameters()
        setattr(parameters, name, value)
        detector = cv2.aruco.ArucoDetector(opencv_dictionary("DICT_5X5_50"), parameters)
        seconds, false, candidates = [], 0, 0
        for frame in frames:
            begun = time.process_time()
            found, _, rejected = detector.detectMarkers(frame)
            seconds.append(time.process_time() - begun)
            false += len(found)
            candidates += len(found) + len(rejected)
        rows.append([f"`{name}` {value}", f"{1e3 * np.median(seconds):.1f}",
                     f"{false} of {candidates:,}"])
    print("60 frames of clutter, 640 x 480: median CPU time, and false markers of candidates:\n")
    table(["setting", "ms a frame", "false markers"], rows)


def clutter(rng: np.random.Generator) -> np.ndarray:
    """Return a frame (480, 640) of 80 squares of random modules, most with a black border."""
    frame = np.full((480, 640), 128, dtype=np.uint8)
    for _ in range(80):
        bits = (rng.random((7, 7)) < 0.5).astype(np.uint8) * 255
        if rng.random() < 0.8:
            bits[[0, -1]] = 0
            bits[:, [0, -1]] = 0
        side = int(rng.integers(14, 40))
        square = cv2.resize(np.pad(bits, 1, constant_values=255), (side, side),
                            interpolation=cv2.INTER_AREA)
        x, y = int(rng.integers(0, 640 - side)), int(rng.integers(0, 480 - side))
        frame[y : y + side, x : x + side] = square
    return frame


def worked_example(_trials: int | None, _workers: int | None) -> None:
    """Draw ID 7 at 20 px, as read at 4 and at 8 samples a cell."""
    from figures import draw_worked_example  # noqa: PLC0415  (Matplotlib is slow to import)

    draw_worked_example(FOLDER / "worked_example.png")


PARTS = {
    "closed_form": closed_form, "worked_example": worked_example, "dictionaries": dictionaries,
    "settings": settings, "costs": costs,
}


def main() -> None:
    """Make the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="NAME",
                        help=f"parts to make: {', '.join(PARTS)}")
    parser.add_argument("--trials", type=int, help="trials of every sweep, in stores of their own")
    parser.add_argument("--workers", type=int, help="processes (default: one a processor)")
    asked = parser.parse_args()
    for name in asked.only:
        PARTS[name](asked.trials, asked.workers)


if __name__ == "__main__":
    main()
