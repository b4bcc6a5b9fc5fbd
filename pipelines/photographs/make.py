"""The figures and tables of "What reality adds": photographs, and simulations of their markers.

    python pipelines/photographs/make.py NAME=FOLDER=BOARD.toml ... [--camera FILE] [--stereo FILE]

Each set of photographs is measured; a scene is fitted to it, once with all effects and once without
those of `NEW`; its markers are simulated with both at the same poses. Stores go to runs/; what is
finished there is not computed again. Tables are printed as Markdown, figures are written to the
folder of --output (default: this file's).
"""  # noqa: INP001  (a folder of a page, not a package)

# ruff: noqa: T201

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import xarray as xr
from figures import draw_errors, draw_residuals
from numpy.typing import NDArray

import sweep
from sweep.analysis import simulation_gap
from sweep.fitting.photograph_fit import (
    START,
    VARIANCE,
    fit_photograph,
    photograph_views,
)
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import render
from sweep.model.scene import build_scenes
from sweep.photographs.prepare import read_scene, twin_pipeline
from sweep.report.findings import gap_table
from sweep.store.lifecycle import read_pipeline

FOLDER = Path(__file__).parent

REFINEMENTS = ("none", "subpix", "contour", "apriltag")
SETTINGS = [f"cornerRefinementMethod={list(REFINEMENTS)}".replace("'", '"')]

NEW = ("sharpening", "sharpening_px", "bloom", "noise_table", "noise_correlation", "geometry_px",
       "geometry_length_px", "edge_px", "edge_length_px", "marker_scale",
       "decimation", "jpeg_quality")
"""Effects that simulations had not before photographs were measured."""

REPEATS = 4
"""Simulations of each photograph."""

MARKERS = 12
"""Markers of a photograph to which a scene is fitted."""

PLANE_PX = 160
"""Pixels along the side of a mean image."""

QUIET = 0.12
"""Quiet zone in mean images, in sides of the marker."""

MIN_SIDE_PX = 20.0
"""Side of the markers that are averaged."""

NOTHING_RANDOM = {"noise_grey": 0.0, "noise_table": [], "geometry_px": 0.0, "edge_px": 0.0}


def central(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene with the middle of each distribution, without noise and shifts."""
    middle = {
        name: float(np.mean(value["uniform"])) if isinstance(value, dict) else value
        for name, value in scene.items()
    }
    return {**middle, **{name: none for name, none in NOTHING_RANDOM.items() if name in scene}}


def plane_images(pipeline: sweep.Pipeline) -> list[NDArray[np.float64]]:
    """Return the images of all markers of photographs, or twins, in the marker's plane.

    Each is (PLANE_PX, PLANE_PX), and has ``QUIET`` of the marker's side around the marker.
    """
    lengths = [len(axis) for axis in pipeline.experiment.scene_axes]
    indices = [index.ravel() for index in np.indices(lengths, dtype=np.intp)]
    count = len(indices[0])
    experiment = pipeline.experiment
    scenes = build_scenes(experiment.scene_values(indices), count, experiment.scene_plugins)
    boxes = marker_boxes(scenes)
    low = QUIET * PLANE_PX / (1 + 2 * QUIET) - 0.5
    high = PLANE_PX - 1 - low
    target = np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)
    found = []
    for row, corners in enumerate(scenes.corners_px):
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        if not sides.min() >= MIN_SIDE_PX:  # NaN: not in the photograph
            continue
        reach = QUIET * sides.max() + 4
        box = boxes[row].reshape(2, 2)
        left, top = np.minimum(np.floor(corners.min(axis=0) - reach).astype(int), box[0])
        right, bottom = np.maximum(np.ceil(corners.max(axis=0) + reach).astype(int), box[1])
        width, height = scenes.frame[row]
        window = (max(left, 0), max(top, 0), min(right, width), min(bottom, height))
        image = render(scenes, row, boxes[row], window).astype(np.float64)
        turned = cv2.getPerspectiveTransform((corners - window[:2]).astype(np.float32), target)
        found.append(cv2.warpPerspective(
            image, turned, (PLANE_PX, PLANE_PX), flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE))
    return found


def mean_images(
    photographs: sweep.Pipeline, scenes: Mapping[str, Mapping[str, Any]]
) -> dict[str, NDArray[np.float64]]:
    """Return the mean image of the markers, and the mean of what each scene's images lack."""
    shots = plane_images(photographs)
    means = {}
    for source, scene in scenes.items():
        levels, residuals = [], []
        for shot, twin in zip(
            shots, plane_images(twin_pipeline(photographs, central(scene))), strict=True
        ):
            design = np.stack([twin.ravel(), np.ones(twin.size)], axis=1)
            (gain, offset), *_ = np.linalg.lstsq(design, shot.ravel(), rcond=None)
            contrast = gain * np.ptp(np.quantile(twin, [0.02, 0.98]))
            residuals.append((shot - gain * twin - offset) / contrast)
            levels.append((shot - np.quantile(shot, 0.02)) / contrast)
        means["photographs"] = np.mean(levels, axis=0)
        means[source] = np.mean(residuals, axis=0)
    return means


def older_scene(photographs: sweep.Pipeline, fitted: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene without the new effects: the blur is fitted without them, the noise is white.

    The blur is the mean over the photographs, as in a fitted scene without a spread.
    """
    moved = np.zeros(len(START), dtype=bool)
    moved[VARIANCE] = True
    fits = [
        fit for each in photograph_views(photographs, MARKERS)[0].values()
        if (fit := fit_photograph(each, moved, START)) is not None
    ]
    variance = float(np.mean([fit.parameters[VARIANCE] for fit in fits]))
    deviations = fitted.get("noise_table", [])[1::2] or [0.0]
    return {
        **{name: value for name, value in fitted.items() if name not in NEW},
        "blur_px": math.sqrt(max(variance, 0.0)),
        "noise_grey": float(np.mean(deviations)),
    }


def results_of(name: str, pipeline: sweep.Pipeline) -> xr.Dataset:
    """Return a pipeline's results from its store in runs/, which is completed if need be."""
    return sweep.run(pipeline, store=f"runs/{name}.zarr", progress=False)


def compared(
    name: str, folder: Path, board: Path, camera: str, stereo: str | None
) -> tuple[dict[str, xr.Dataset], dict[str, NDArray[np.float64]]]:
    """Return the results of photographs and simulations, and their mean images; print the gaps."""
    shots = sweep.photos(
        folder, camera=None if stereo else camera, board=board, stereo=stereo, settings=SETTINGS,
        store=f"runs/{name}.zarr", progress=False)
    photographs = read_pipeline(f"runs/{name}.zarr")
    path = Path(f"runs/{name}.toml")
    if not path.exists():
        path.write_text(sweep.fit(
            folder, camera=None if stereo else camera, board=board, stereo=stereo,
            markers=MARKERS).text)
    print(f"\n## {name}\n\n```")
    print("".join(line for line in path.read_text().splitlines(keepends=True)
                  if line.startswith("#")), end="```\n")
    scenes = {"fitted": read_scene(path)}
    scenes["without new effects"] = older_scene(photographs, scenes["fitted"])
    results = {"photographs": shots}
    for source, scene in scenes.items():
        results[source] = results_of(
            f"{name}-{source.replace(' ', '-')}", twin_pipeline(photographs, scene, REPEATS))
        print(f"\n{name}, {source}:\n")
        print(gap_table(simulation_gap(shots, results[source]).load()).markdown())
    return results, mean_images(photographs, scenes)


def main() -> None:
    """Make the page's figures, and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", metavar="NAME=FOLDER=BOARD",
                        help="name of a set, its folder, and the TOML file of its board")
    parser.add_argument("--camera", default="calibrate", help="as for `sweep photos`")
    parser.add_argument("--stereo", action="append", default=[], metavar="NAME=FILE",
                        help="calibration of a set's stereo camera")
    parser.add_argument("--output", type=Path, default=FOLDER, metavar="FOLDER")
    options = parser.parse_args()
    stereo = dict(each.split("=", 1) for each in options.stereo)
    results, images = {}, {}
    for each in options.sets:
        name, folder, board = each.split("=")
        results[name], images[name] = compared(
            name, Path(folder), Path(board), options.camera, stereo.get(name))
    draw_errors(options.output / "errors.png", results, REFINEMENTS)
    draw_residuals(options.output / "residuals.png", images)


if __name__ == "__main__":
    main()
