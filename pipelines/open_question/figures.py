"""The figures of the page "The paper's open question"."""  # noqa: INP001  (not a package)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from bit_reading import reading_of
from dips import Rates
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.measure.detectors import DetectorSetting
from sweep.model.marker import modules
from sweep.report.figure import COLOURS, INK

BLUE, VERMILION, GREEN, _, SKY, ORANGE, _ = COLOURS
FAINT, RULE, STRIP = "#7a7a7a", "#e6e6e6", "#f3f3f3"
STYLE = {
    "font.size": 9, "axes.titlesize": 9.5, "axes.titlelocation": "left",
    "axes.titleweight": "bold", "axes.edgecolor": FAINT, "axes.labelcolor": INK,
    "axes.titlecolor": INK, "text.color": INK, "xtick.color": FAINT, "ytick.color": FAINT,
    "xtick.labelcolor": INK, "ytick.labelcolor": INK, "axes.linewidth": 0.7,
    "axes.spines.top": False, "axes.spines.right": False, "grid.color": RULE,
    "axes.axisbelow": True, "legend.frameon": False, "figure.constrained_layout.use": True,
}
WIDTH = 9.0
"""Inches; a point is 1.4 px where the figure is 900 px wide."""
DOTS_PER_INCH = 150

MARKER_ID, SIDE_PX, LEFT_PX, TOP_PX, FRAME_PX = 7, 20.0, 21.5, 21.25, 64
"""The worked example, DICT_5X5_50: the square's edges, pixel centres being whole numbers."""
FIRST_PX, LAST_PX = 22, 41
"""The first and the last pixel with its centre in that square, in x and in y."""


def draw_rates(path: Path, truth: Rates, model: Rates, second: frozenset[int]) -> None:
    """Draw measured and predicted rates of the IDs with (``second``) and without the second dip."""
    has = np.isin(truth.ids, sorted(second))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.5))
        axes = figure.subplots()
        axes.axvspan(350, 450, color=STRIP, zorder=0)
        axes.axvspan(298, 302, color=STRIP, zorder=0)
        for area, words in ((300, "first, 300"), (400, "second, 350-450")):
            axes.text(area, 2, f"the paper's\n{words}", ha="center", va="bottom", color=FAINT)
        axes.axvline((2.1 * 7) ** 2, color=RULE, lw=1)
        axes.text((2.1 * 7) ** 2, 40, " 2.1 px a module", color=FAINT)
        for who, colour, words in (
            (has, VERMILION, "two or more lone cells in the middle column or row"),
            (~has, BLUE, "at most one"),
        ):
            axes.plot(truth.areas_px2, 100 * truth.rates[:, who].mean(axis=1), color=colour,
                      lw=2, alpha=0.65, label=f"{who.sum()} IDs with {words}, measured")
            axes.plot(model.areas_px2, 100 * model.rates[:, who].mean(axis=1), color=colour,
                      lw=1.4, ls=(0, (3, 2)), label="predicted")
        axes.set(xlim=(70, 484), ylim=(0, 102), xlabel="area of the black square, px²",
                 ylabel="detected, %")
        axes.grid(axis="y")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.14))
        axes.set_title("Detection rate of frontal markers, DICT_5X5_50")
        figure.savefig(path, dpi=DOTS_PER_INCH)


def draw_sweeps(path: Path, shown: Sequence[tuple[str, Rates, Rates]]) -> None:
    """Draw measured and predicted rates, mean of the IDs, of (title, measured, predicted) each."""
    with mpl.rc_context(STYLE | {"axes.titlesize": 8.5}):
        rows = (len(shown) + 2) // 3
        figure = Figure(figsize=(WIDTH, 1.85 * rows))
        panels = figure.subplots(rows, 3, squeeze=False, sharey=True)
        for axes, (what, truth, model) in zip(panels.flat, shown, strict=False):
            axes.plot(truth.areas_px2, 100 * truth.mean, color=BLUE, lw=2, alpha=0.65,
                      label="measured")
            axes.plot(model.areas_px2, 100 * model.mean, color=VERMILION, lw=1.4,
                      ls=(0, (3, 2)), label="predicted")
            axes.set(xlim=(truth.areas_px2[0], truth.areas_px2[-1]), ylim=(0, 102))
            axes.grid(axis="y")
            axes.set_title(what)
        panels[0, 0].legend(loc="lower right")
        for axes in panels[-1]:
            axes.set_xlabel("area, px²")
        for axes in panels[:, 0]:
            axes.set_ylabel("detected, %")
        figure.savefig(path, dpi=DOTS_PER_INCH)


def example_image() -> np.ndarray:
    """Return the worked example's image: the bitmap at 10 px a module, warped (bilinear)."""
    bits = modules("DICT_5X5_50", MARKER_ID).astype(np.uint8) * 255
    bitmap = np.pad(np.kron(bits, np.ones((10, 10), dtype=np.uint8)), 10, constant_values=255)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    onto = cv2.getPerspectiveTransform(9.5 + 70 * unit,
                                       np.float32([LEFT_PX, TOP_PX]) + np.float32(SIDE_PX) * unit)
    return cv2.warpPerspective(bitmap, onto, (FRAME_PX, FRAME_PX), flags=cv2.INTER_LINEAR)


def as_read(image: np.ndarray, cell_px: int) -> np.ndarray:
    """Return the canonical image (7p, 7p) of p samples a cell, True where white."""
    size = 7 * cell_px
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    onto = cv2.getPerspectiveTransform(
        FIRST_PX + np.float32(LAST_PX - FIRST_PX) * unit, np.float32(size - 1) * unit)
    canonical = cv2.warpPerspective(image, onto, (size, size), flags=cv2.INTER_NEAREST)
    return cv2.threshold(canonical, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1] > 0


def draw_worked_example(path: Path) -> None:
    """Draw ID 7 at 20 px: the image and where the middle column is read; 4 and 8 samples a cell."""
    image = example_image()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.75))
        first, *others = figure.subplots(1, 3)
        _draw_image(first, image)
        for axes, cell_px in zip(others, (4, 8), strict=True):
            _draw_reading(axes, as_read(image, cell_px), cell_px)
        figure.savefig(path, dpi=DOTS_PER_INCH)


def _draw_image(axes: Axes, image: np.ndarray) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    for k in range(8):
        at = k * SIDE_PX / 7
        axes.plot([LEFT_PX + at] * 2, [TOP_PX, TOP_PX + SIDE_PX], color=SKY, lw=0.6)
        axes.plot([LEFT_PX, LEFT_PX + SIDE_PX], [TOP_PX + at] * 2, color=SKY, lw=0.6)
    low, high = FIRST_PX, LAST_PX
    axes.plot([low, high, high, low, low], [low, low, high, high, low], color=ORANGE, lw=1.8)
    reads = FIRST_PX + np.rint(np.arange(28) * (LAST_PX - FIRST_PX) / 27)
    axes.scatter(*np.meshgrid(reads[12:16], reads), s=11, color=VERMILION, zorder=3, linewidths=0)
    axes.set(xlim=(LEFT_PX, LEFT_PX + SIDE_PX), ylim=(TOP_PX + SIDE_PX, TOP_PX),
             xticks=range(22, 42, 3), yticks=range(22, 42, 3), xlabel="pixel")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title("Side 20 px: corners at 22 and 41,\nsamples of the middle column")


def _draw_reading(axes: Axes, white: np.ndarray, cell_px: int) -> None:
    reading = reading_of("DICT_5X5_50", 640, 480,
                         DetectorSetting(perspectiveRemovePixelPerCell=cell_px))
    margin = reading.margin_px
    cells = white.reshape(7, cell_px, 7, cell_px)
    share = cells[:, margin : cell_px - margin, :, margin : cell_px - margin].mean(axis=(1, 3))
    bits = modules("DICT_5X5_50", MARKER_ID)
    wrong = np.where(bits, 1 - share, share) > reading.valid_share
    axes.imshow(white, cmap="gray", extent=(0, 7, 7, 0))
    for k in range(8):
        axes.axhline(k, color=SKY, lw=0.6)
        axes.axvline(k, color=SKY, lw=0.6)
    for row, column in np.argwhere((share > 0) & (share < 1)):
        amiss = wrong[row, column]
        axes.text(
            column + 0.5, row + 0.5, f"{100 * share[row, column]:.0f}", ha="center", va="center",
            fontsize=8.5, color="white" if amiss else INK, weight="bold" if amiss else None,
            bbox={"boxstyle": "round,pad=0.22", "lw": 0,
                  "facecolor": VERMILION if amiss else "white"},
        )
    axes.set(xticks=np.arange(7) + 0.5, xticklabels=range(7), yticks=np.arange(7) + 0.5,
             yticklabels=range(7), xlabel="cell; numbers: white samples, %")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    found = wrong.sum() <= reading.corrected_bits
    axes.set_title(f"{cell_px} samples a cell: {wrong.sum()} wrong bits,\n"
                   + ("found" if found else f"{reading.corrected_bits} is corrected: lost"))
