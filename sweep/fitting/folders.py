"""From a folder of photographs to a fitted scene, its check on held-out photographs."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import simulation_gap
from sweep.analysis.comparisons import GAP_STATISTICS
from sweep.errors import ArgumentError
from sweep.execution.runner import execute
from sweep.experiment.document import document_text, read_document
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.photographs import SUFFIX, PhotographRecord
from sweep.experiment.pipeline import Pipeline
from sweep.fitting.fit import (
    MARKERS,
    Estimate,
    Say,
    SceneFit,
    fit_scene,
    scene_views,
    shortened,
)
from sweep.fitting.photograph_fit import Views
from sweep.measure.surroundings import clear_modules
from sweep.messages import notice, plain
from sweep.photographs.prepare import name_of, prepare, setting_name
from sweep.photographs.twins import record_of, twin_pipeline
from sweep.store.files import write_whole
from sweep.store.lifecycle import open_dataset
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# A fitted scene against photographs that were not used to fit it.
#
# The markers of the held-out photographs are simulated at their poses with the scene that the
# others gave, and with each of its effects left out in turn. The pixels of the fitted photographs
# show each effect, so one is left out only where the gap between the errors of photographs and
# simulation is clearly narrower without it, and without all such effects together.

#: Held-out photographs from which errors have intervals.
MIN_HELD_OUT = 5

#: Markers of a photograph whose errors are compared.
MAX_MARKERS = 12

#: Simulations of each photograph. With one, the simulation's own random errors decide whether an
#: effect narrows the gap. Effects that move no error (light, the noise's correlation) changed it by
#: ± 0.02 half-widths of the intervals (standard deviation) with eight.
REPEATS = 4

#: Half-widths of the intervals by which the mean gap is narrower without an effect that is left
#: out: a standard deviation of the photographs' own random errors. Of rendered photographs, gaps
#: were narrower by 0.11 and 0.15 without a sharpening and a bloom with which they had been
#: rendered.
CLEARLY = 0.5

#: Effects that are kept where the errors of photographs that were not fitted say so.
SWITCHES = ("sharpening", "bloom", "geometry_px", "edge_px", "marker_scale")

NOT_NEEDED = "errors are clearly nearer to those of photographs that were not fitted without it"


def gap_size(gap: xr.Dataset, widths: xr.Dataset) -> float:
    """Return the mean size of all statistics' gaps, in half-widths of the intervals of ``widths``.

    Of ratios the logarithms count. NaN if nothing has an interval.
    """
    sizes = []
    for each in GAP_STATISTICS:
        value, low, high = (
            np.asarray(source[f"{each.name}_gap{end}"].values, dtype=np.float64)
            for source, end in ((gap, ""), (widths, "_low"), (widths, "_high"))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            if each.ratio:
                value, low, high = np.log(value), np.log(low), np.log(high)
            sizes.append((np.abs(value) / (0.5 * (high - low))).ravel())
    every = np.concatenate(sizes)
    known = every[np.isfinite(every)]
    return float(known.mean()) if len(known) else math.nan


def needed(whole: xr.Dataset, without: Mapping[str, xr.Dataset]) -> dict[str, bool]:
    """Return which effects the gap is not clearly narrower without.

    ``whole`` is the gap with the whole scene, ``without`` that without each effect.
    """
    least = gap_size(whole, whole) - CLEARLY
    return {switch: gap_size(gap, whole) > least for switch, gap in without.items()}


def held_out(pipeline: Pipeline, numbers: Integers, folder: Path) -> Pipeline:
    """Return the pipeline of some of the photographs, by number; their record goes to a folder."""
    record, name = record_of(pipeline), "held-out"
    chosen = dataclasses.replace(
        record, **{
            each: getattr(record, each)[numbers]
            for each in ("rotation", "translation", "std", "source")
        },
        paths=tuple(str((Path(pipeline.folder) / record.paths[k]).resolve()) for k in numbers),
        digests=tuple(record.digests[k] for k in numbers),
    )
    write_whole(folder / f"{name}{SUFFIX}", chosen.content())
    document = read_document(pipeline.to_toml())
    document["scene"][PHOTOGRAPHS] = f"{name}{SUFFIX}"
    axes = document["axes"]
    axes["trial"] = len(numbers)
    if "marker_id" in axes:
        every = record.marker_id
        spread = np.unique(np.linspace(0, len(every) - 1, MAX_MARKERS).astype(np.int64))
        axes["marker_id"] = every[spread].tolist()
    return Pipeline.from_dict(document, name=name, source="held out", folder=folder)


def checked(
    found: SceneFit, views: Views, pipeline: Pipeline, home: Path, say: Say
) -> tuple[SceneFit, xr.Dataset]:
    """Return the scene with what moves errors of held-out photographs, and the gap that is left.

    Every other photograph is held out, and the scene of the others simulated; stores go to
    ``home``.
    """
    numbers, known = list(views), found.tested_fits
    others, held = {number: views[number] for number in numbers[::2]}, np.array(numbers[1::2])
    say(f"measuring {len(held)} photographs that the scene of the others is compared with")
    photographs = held_out(pipeline, held, home)

    def measured(experiment: Pipeline, name: str) -> xr.Dataset:
        store = str(home / f"{name.replace(' ', '-')}.zarr")
        execute(experiment, store, overwrite=True)
        return open_dataset(store)

    def gap_with(scene: Mapping[str, Any], name: str) -> xr.Dataset:
        say(f"simulating them with {name}")
        twins = twin_pipeline(photographs, scene, REPEATS)
        return simulation_gap(results, measured(twins, name)).load()

    results = measured(photographs, photographs.name)
    half = fit_scene(others, known=known).scene
    gap = gap_with(half, "the whole scene")
    kept = needed(gap, {
        switch: gap_with(
            fit_scene(others, {switch: NOT_NEEDED}, known).scene, f"all but {switch}"
        ) for switch in SWITCHES if switch in half
    })
    refused = {switch: NOT_NEEDED for switch, keep in kept.items() if not keep}
    if refused:
        rest = gap_with(fit_scene(others, refused, known).scene, "what is kept")
        if gap_size(rest, gap) <= gap_size(gap, gap):
            return fit_scene(views, refused, known), rest
    return found, gap


# --------------------------------------------------------------------------------------------------
# The file of a fitted scene: a whole pipeline of the camera, as TOML with its intervals.

CAMERA = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")

#: Share of the photographs' bearings that the poses of the pipeline keep to, lest their markers be
#: cut by the frame.
MAX_BEARING = 0.8

TRIALS = 200


def scene_document(pipeline: Pipeline, views: Views, found: SceneFit) -> dict[str, Any]:
    """Return a pipeline of the fitted camera, with poses as in the photographs."""
    record, fixed = record_of(pipeline), pipeline.fixed
    first = next(iter(views.values()))[0].shown
    marker = {
        "dictionary": first.marker.dictionary, "marker_id": first.marker.marker_ids[0],
        "size_m": first.size_m,
    }
    on_board = [each for each in record.on_board(record.marker_id) if each is not None]
    if on_board:
        marker["quiet_zone_modules"] = shortened(min(10.0, *map(clear_modules, on_board)))
    rotation, translation = record.rotation[record.shown], record.translation[record.shown]
    tilt = np.degrees(np.arccos(np.clip(-rotation[:, 2, 2], -1, 1)))
    bearing = np.abs(translation[:, :2] / translation[:, 2:])
    wide = np.degrees(np.arctan(MAX_BEARING * np.quantile(bearing, 0.9, axis=0))).tolist()
    turned = {"uniform": [0.0, 360.0]}
    return {
        "title": f"The camera of {plain(pipeline.name)}",
        "camera": {
            name: list(fixed[name]) if name == "distortion" else fixed[name] for name in CAMERA
        },
        "marker": marker,
        "pose": {
            "distance_m": _between(translation[:, 2]), "tilt_deg": _between(tilt),
            "azimuth_deg": turned, "roll_deg": turned,
            **{
                name: {"uniform": [-shortened(each), shortened(each)]}
                for name, each in zip(("bearing_x_deg", "bearing_y_deg"), wide, strict=True)
                if each > 0
            },
        },
        "scene": found.scene,
        "axes": {"trial": TRIALS, "cornerRefinementMethod": ["none", "subpix"]},
    }


def _between(values: Floats) -> Any:
    """Return a uniform distribution between the quantiles 5 and 95 %."""
    low, high = (shortened(each) for each in np.quantile(values, [0.05, 0.95]).tolist())
    return {"uniform": [low, high]} if low < high else low


def scene_text(
    document: dict[str, Any], found: SceneFit, record: PhotographRecord, name: str,
    lines: Sequence[str] = (),
) -> str:
    """Return the content of the file: its source, the terms, and the pipeline."""
    digest = hashlib.sha256("".join(record.digests).encode()).hexdigest()
    head = [
        f"Fitted to {found.markers} markers in {found.photographs} photographs ({plain(name)}),",
        f"SHA-256 of their digests {digest[:16]}. Value, 95 % interval by photograph:",
        *(f"  {each.parameter}: {in_words(each.estimate)}" for each in found.terms if each.kept),
        *(f"  left out: {each.name}: {each.reason}" for each in found.terms if not each.kept),
        *lines, *found.lines,
    ]
    return "".join(f"# {plain(line, 200)}\n" for line in head) + "\n" + document_text(document)


def in_words(one: Estimate) -> str:
    """Return an estimate as a text."""
    if not math.isfinite(one.value):
        return "not known"
    interval = f" [{one.low:.4g}, {one.high:.4g}]" if math.isfinite(one.low) else ""
    return f"{one.value:.4g}{interval}"


# --------------------------------------------------------------------------------------------------
# From a folder of photographs to a fitted scene and its file.

PathName = str | os.PathLike[str]

#: Settings of the markers in the photographs; others set the comparison.
OF_MARKERS = ("dictionary", "size_m")

#: Detector settings that the check compares unless others are given.
COMPARED = 'cornerRefinementMethod=["none", "subpix"]'


@dataclass(frozen=True, slots=True, eq=False)
class FittedScene:
    """A camera's scene from photographs.

    Attributes
    ----------
    found
        Its terms.
    pipeline
        A pipeline of this camera, with poses as in the photographs.
    text
        The pipeline's file, with intervals and left-out terms in its comments.
    lines
        Lines on the photographs for the user.
    gap
        Half of the photographs beside a simulation with the scene that the others gave
        (:func:`sweep.analysis.simulation_gap`); None without a check.
    """

    found: SceneFit
    pipeline: Pipeline
    text: str
    lines: tuple[str, ...]
    gap: xr.Dataset | None


def fit(
    *folders: PathName, camera: PathName | None = None, board: PathName | None = None,
    poses: PathName | None = None, stereo: PathName | None = None, settings: Sequence[str] = (),
    markers: int = MARKERS, check: bool = True,
) -> FittedScene:
    """Estimate a camera's scene: blur, sharpening, tone, noise, geometry, and the print's size.

    Parameters
    ----------
    folders, camera, board, poses, stereo
        As for `sweep.photos`; of a stereo camera the left one's scene is fitted.
    settings
        "key=value" for the dictionary and size_m of single markers, and for the detectors and
        estimators whose errors are compared.
    markers
        The most markers of a photograph that are fitted, well spread over the frame.
    check
        Whether half of the photographs are held out: effects without which simulated errors come
        clearly nearer to theirs are left out, and the gap that is left is in ``gap``.

    Returns
    -------
    FittedScene
        The terms with their intervals (``found.terms``), what the section [scene] has
        (``found.scene``), a pipeline of this camera (``pipeline``) and its file (``text``).

    Raises
    ------
    ArgumentError, PipelineError, StoreError
        As for `sweep.photos`; photographs to which nothing can be fitted are told in a line.

    Examples
    --------
    >>> found = sweep.fit(
    ...     folder / "shots", camera=folder / "camera.json", board=folder / "board.toml",
    ...     markers=2, check=False)
    >>> round(found.found.scene["blur_px"], 1)
    0.6
    """
    if not 1 <= markers <= 1000:
        raise ArgumentError("markers", markers, "expected a whole number from 1 to 1000")
    if all(setting_name(each) in OF_MARKERS for each in settings):
        settings = [*settings, COMPARED]
    with tempfile.TemporaryDirectory() as written:
        home = Path(written).resolve()
        prepared = prepare(
            folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, home=home,
            one_camera=True,
        )
        pipeline, name = prepared.pipeline, name_of(Path(folders[0]))
        views, lines = scene_views(pipeline, markers)
        found, gap = fit_scene(views, say=notice), None
        if check and len(views) >= 2 * MIN_HELD_OUT:
            found, gap = checked(found, views, pipeline, home, notice)
        elif check:
            lines.append(
                f"fewer than {2 * MIN_HELD_OUT} photographs: no half of them is held out, to see "
                "which effects move errors"
            )
        document = scene_document(pipeline, views, found)
        text = scene_text(document, found, record_of(pipeline), name, lines)
    for line in (*prepared.lines, *lines):
        notice(line)
    return FittedScene(
        found, Pipeline.from_dict(document, name=name, source="scene"), text,
        (*prepared.lines, *lines), gap,
    )
