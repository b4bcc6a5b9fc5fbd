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
from pathlib import Path

import cv2
import numpy as np
import xarray as xr
from bit_reading import lone_cells, predicted_rates, reading_of
from dips import PROMINENCE, Rates, dips, half_read, pairs
from quadrilaterals import Surround, upright_corners
from sweeps import (
    DEVELOPMENT,
    HELD_BACK,
    SECOND,
    SENSOR_MM,
    Sweep,
    every_dictionary,
    measured,
    predicted,
    spread,
    written_down,
)

import sweep
from sweep.analysis import compare
from sweep.measure.detectors import DetectorSetting
from sweep.measure.flags import DetectionStatus
from sweep.model.marker import module_count, modules, opencv_dictionary

FOLDER = Path(__file__).parent
PIPELINES = FOLDER.parent

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

NOT_IN_MODEL = ("cornerRefinementMethod", "renderer", "roll_deg", "validBitIdThreshold")

DIPS_PX = ((15.7, 16.5), (16.7, 17.7), (18.9, 21.0))
"""Sides over which the settings' losses are averaged, for each dip."""

SAMPLES = Sweep("DICT_5X5_50", (0, 10), spread(10.0, 14.8, 0.2), 40)
SAMPLES_A_CELL = (4, 5, 6, 8, 16)
SAMPLED_PX = (11.0, 12.0, 13.0, 14.0)
"""Sides below 2.1 px a module at which numbers of samples are compared."""


def swept(
    name: str, pipeline: sweep.Pipeline, trials: int | None, workers: int | None
) -> xr.Dataset:
    """Return a pipeline's results from its store in runs/, which is completed if need be."""
    store = f"runs/{name}.zarr" if trials is None else f"runs/{name}_trials_{trials}.zarr"
    begun = time.perf_counter()
    results = sweep.run(pipeline, store=store, workers=workers)
    print(f"{store}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
    return results.assign(detection=results["detection"].compute())


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table."""
    for row in (header, ["---"] * len(header), *rows):
        print("| " + " | ".join(row) + " |")
    print()


def dip_rows(what: str, model: Rates, truth: Rates) -> list[list[str]]:
    """Return rows of the table of dips: areas, lowest rates, and how far they differ."""
    rows = []
    for mine, its in pairs(model, truth):
        both = mine is not None and its is not None
        rows.append([
            what if not rows else "",
            " / ".join("-" if dip is None else f"{dip.area_px2:.0f}" for dip in (mine, its)),
            f"{100 * (mine.area_px2 / its.area_px2 - 1):+.1f} %" if both else "-",
            " / ".join("-" if dip is None else f"{dip.lowest:.2f}" for dip in (mine, its)),
            f"{mine.lowest - its.lowest:+.2f}" if both else "-",
        ])
    return rows or [[what, "none / none", "-", "-", "-"]]


def rate_row(what: str, model: Rates, truth: Rates, flags: xr.DataArray) -> list[str]:
    """Return a row of the table of rates: how far they differ, and how the marker was lost."""
    off = model.mean - truth.mean
    counts = [int((flags == flag).sum()) for flag in (
        DetectionStatus.rejected, DetectionStatus.no_candidate, DetectionStatus.wrong_id)]
    return [what, f"{flags.size:,}", f"{np.sqrt((off**2).mean()):.3f}",
            f"{np.abs(off).max():.2f} at {truth.areas_px2[np.abs(off).argmax()]:.0f} px²",
            *(f"{count:,}" for count in counts)]


def small(trials: int | None, workers: int | None) -> None:
    """Print rates and dips, predicted and measured, from the detection limit on; draw them."""
    shown, rates, found = [], [], []
    before = written_down()
    for one in (DEVELOPMENT, *HELD_BACK):
        results = swept(f"small_{one.name}", one.pipeline(trials), trials, workers)
        truth = measured(one, results)
        model = predicted(one) if one is DEVELOPMENT else one.rates(before[one.title][:, None])
        what = one.title if one is DEVELOPMENT else f"**{one.title}**"
        rates.append(rate_row(what, model, truth, results["detection"]))
        found += dip_rows(what, model, truth)
        shown.append((one.short_title, truth, model))
    print("Rates, predicted - measured, and lost poses (bold: held back):\n")
    table(["swept", "poses", "rms", "worst", "rejected", "no_candidate", "wrong_id"], rates)
    print(f"Dips of a prominence of {PROMINENCE} or more, predicted / measured:\n")
    table(["swept", "area, px²", "off", "lowest rate", "off"], found)
    from figures import draw_rates, draw_sweeps  # noqa: PLC0415  (Matplotlib is slow to import)

    _, truth, model = shown[0]
    draw_rates(FOLDER / "second_dip.png", truth, model, ruled("DICT_5X5_50", truth.ids)[1])
    draw_sweeps(FOLDER / "held_back.png", shown[1:])


def every(trials: int | None, workers: int | None) -> None:
    """Print the dips below 2.4 px a module of every predefined dictionary, frontal."""
    rates = []
    for one in every_dictionary():
        results = swept(f"every_{one.name}", one.pipeline(trials), trials, workers)
        truth, model = measured(one, results), predicted(one)
        off = model.mean - truth.mean
        half = float(np.interp(0.5, np.maximum.accumulate(truth.mean), truth.sides_px))
        n = module_count(one.dictionary)
        rates.append([
            one.dictionary.removeprefix("DICT_"), str(n), f"{half / n:.2f}",
            "; ".join(f"{dip.area_px2:.0f} ({dip.lowest:.2f})" for dip in dips(truth)) or "none",
            "; ".join(f"{dip.area_px2:.0f} ({dip.lowest:.2f})" for dip in dips(model)) or "none",
            f"{np.sqrt((off**2).mean()):.3f}", f"{np.abs(off).max():.2f}",
        ])
    print("Every dictionary, last ten IDs, frontal; dips as area in px² (lowest rate):\n")
    table(["dictionary", "n", "half detected from, px a module", "dips measured",
           "dips predicted", "rms", "worst"], rates)


def second(trials: int | None, workers: int | None) -> None:
    """Print which IDs have the second dip, by the rule of lone cells and as measured."""
    rule = []
    for one in SECOND:
        results = swept(f"second_{one.name}", one.pipeline(trials), trials, workers)
        truth, model = measured(one, results), predicted(one)
        corrected, named = ruled(one.dictionary, truth.ids)
        having = [rates.having(18.9, 21.2) for rates in (truth, model)]
        rule.append([one.title, str(corrected), str(len(named)),
                     f"{len(having[0])} of {len(truth.ids)}", str(len(named ^ having[0])),
                     str(len(having[1])), str(len(having[1] ^ having[0])),
                     f"{model.mean.min():.3f} / {truth.mean.min():.3f}"])
    print("More lone cells in the middle column or row than are corrected, against the second dip "
          "as measured:\n")
    table(["swept", "corrected bits", "IDs by the rule", "IDs measured", "differ",
           "IDs by the model", "differ", "lowest rate, predicted / measured"], rule)


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


def samples(trials: int | None, workers: int | None) -> None:
    """Print what other numbers of samples a cell do below 2.1 px a module."""
    pipeline = sweep.Pipeline.from_toml(PIPELINES / "second_dip_settings.toml", [
        *SAMPLES.settings(trials), f"perspectiveRemovePixelPerCell={list(SAMPLES_A_CELL)}"])
    results = swept("small_samples", pipeline, trials, workers)
    rows = []
    for count in SAMPLES_A_CELL:
        truth = measured(SAMPLES, results.sel(perspectiveRemovePixelPerCell=count)).mean
        model = predicted(SAMPLES, DetectorSetting(perspectiveRemovePixelPerCell=count)).mean
        at = [SAMPLES.sides_px.index(side) for side in SAMPLED_PX]
        rows.append([str(count), *(f"{truth[k]:.2f} ({model[k]:.2f})" for k in at),
                     f"{truth.mean():.2f} ({model.mean():.2f})"])
    print("Rate by samples a cell (the model's in brackets), 5X5_50, IDs 0-9:\n")
    table(["samples a cell", *(f"{side**2:.0f} px²" for side in SAMPLED_PX), "10-14.8 px"], rows)


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
        rows += [setting_row(name, value, values[0], results) for value in values]
    print("Loss in % at the three dips and at the other sides of 15.2-21.8 px (the model's in "
          "brackets), poses with a wrong ID, McNemar's p against the default:\n")
    table(["changed", "value", "257 px²", "292 px²", "391 px²", "elsewhere", "wrong ID", "p"],
          rows)


def setting_row(
    name: str, value: object, default: object, results: xr.Dataset
) -> list[str]:
    """Return a row of the table of settings."""
    one = results.sel({name: value})
    sides = one["side_px"].to_numpy()
    lost = (one["detection"] != DetectionStatus.detected).mean(["marker_id", "trial"]).to_numpy()
    detecting = name in {field.name for field in dataclasses.fields(DetectorSetting)}
    model = None
    if name not in NOT_IN_MODEL:
        model = losses_of(sides, one["marker_id"].to_numpy(), name, value, detecting)
    rest = np.ones(len(sides), dtype=bool)
    cells = []
    for low, high in DIPS_PX:
        within = (sides > low - 1e-6) & (sides < high + 1e-6)
        rest &= ~within
        cells.append(within)
    cells.append(rest)
    losses = [
        f"{100 * lost[within].mean():.1f}"
        + ("" if model is None else f" ({100 * model[within].mean():.1f})")
        for within in cells
    ]
    wrong = int((one["detection"] == DetectionStatus.wrong_id).sum())
    p_value = "-"
    if detecting and value != default:
        p = float(compare(results.sel({name: default}), one)["detection_p_value"])
        p_value = f"{p:.2g}" if p >= 1e-6 else "<1e-6"
    return [f"`{name}`", str(value), *losses, f"{wrong:,} of {one['detection'].size:,}", p_value]


def losses_of(
    sides: np.ndarray, ids: np.ndarray, name: str, value: object, detecting: bool
) -> np.ndarray:
    """Return the model's losses (S,) with one setting or scene parameter changed."""
    setting = DetectorSetting(**{name: value}) if detecting else DetectorSetting()
    surround = Surround(
        quiet_zone=value if name == "quiet_zone_modules" else 1.0,
        background=value if name == "background" else 0.0,
    )
    tilt_deg = value if name == "tilt_deg" else 0.0
    reading = reading_of("DICT_5X5_50", 640, 480, setting)
    bits = np.array([modules("DICT_5X5_50", int(i)) for i in ids])
    return np.array([
        1.0 - predicted_rates(
            bits, upright_corners(side, tilt_deg, 0.0, 4.0 * 640 / SENSOR_MM), reading, surround,
        ).mean() for side in sides
    ])


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
    "closed_form": closed_form, "worked_example": worked_example, "small": small, "every": every,
    "second": second, "samples": samples, "settings": settings, "costs": costs,
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
