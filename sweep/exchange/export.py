"""Export of an experiment: its images, their truth, and camera files, in a folder."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd
import xarray as xr
import yaml
from jinja2 import Template
from numpy.typing import NDArray
from rich import filesize

from sweep.errors import RunError, StoreError, check_positive
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SceneBatch, common_windows, scenes_at, searched_windows
from sweep.evaluation.variables import GEOMETRY, target_areas_px
from sweep.exchange.answers import CORNER_COLUMNS, POSITION, VECTOR
from sweep.execution.forecast import free_bytes
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LABELS
from sweep.isolation.child_process import end_with
from sweep.measure.flags import DetectionStatus
from sweep.messages import label, plain
from sweep.model.polygon import signed_areas
from sweep.model.renderers import render
from sweep.model.scene import Scenes
from sweep.store.files import write_whole
from sweep.store.lifecycle import planned_arrays
from sweep.store.locations import translate_errors
from sweep.store.provenance import environment, fingerprint
from sweep.typing import Integers

# --------------------------------------------------------------------------------------------------
# An experiment's scenes as images. There is one of each visible scene: its target is in the frame,
# and the lens model holds there.

#: Scenes that are in memory together.
BATCH = 256


class Images(NamedTuple):
    """N scenes as images: their names, and the part of the frame that each shows.

    ``windows`` (N, 4) are left, top, right, bottom in pixels of the frame, half-open.
    """

    batch: SceneBatch
    names: list[str]
    windows: Integers


def images_of(pipeline: Pipeline, numbers: Sequence[int], *, windowed: bool) -> Images:
    """Return scenes by their places (N,) in the grid of scene axes, the last axis fastest.

    A window is the smallest that holds the windows of all detector settings of the experiment; if
    images are not ``windowed`` it is the frame. A name is the number, which sorts, and half of the
    key by which an image is known (:func:`sweep.experiment.experiment.Experiment.image_keys`).
    """
    indices = pipeline.experiment.all_scenes.indices(np.array(numbers, dtype=np.intp))
    batch = scenes_at(pipeline.experiment, indices)
    keys = pipeline.experiment.image_keys(indices).tolist()
    frame = batch.scenes.frame
    return Images(
        batch,
        [f"{number:06d}-{key & 0xFFFFFFFF:08x}.png"
         for number, key in zip(numbers, keys, strict=True)],
        common_windows(searched_windows(batch)) if windowed
        else np.concatenate([np.zeros_like(frame), frame], axis=1))


def encoded_image(images: Images, row: int) -> bytes:
    """Return a scene's image as PNG; RunError if it cannot be rendered."""
    batch = images.batch
    try:
        with single_threaded():
            x0, y0, x1, y1 = images.windows[row].tolist()
            image = render(batch.scenes, row, batch.boxes[row], (x0, y0, x1, y1))
            _, encoded = cv2.imencode(".png", image)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError, cv2.error) as error:
        raise RunError(f"image {images.names[row]}: {plain(error, 300)}") from None
    return bytes(encoded.tobytes())


# --------------------------------------------------------------------------------------------------
# Camera files for other programs: OpenCV's FileStorage and ROS's camera_info.
#
# Both put pixel (0, 0) at the centre of the top left pixel and have OpenCV's lens model, as the
# simulation does.

#: A camera as files have it: frame in pixels, (fx, fy, cx, cy) in px, and coefficients of its lens.
FileCamera = tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...]]


def camera_of(scenes: Scenes, row: int) -> FileCamera:
    """Return the camera of a scene, with 5, 8, 12 or 14 coefficients."""
    coefficients = scenes.cameras.lenses[row, :14].tolist()
    count = next(length for length in (5, 8, 12, 14) if not any(coefficients[length:]))
    return (tuple(scenes.frame[row].tolist()), tuple(scenes.cameras.view[row].tolist()),
            tuple(coefficients[:count]))


def camera_files(camera: FileCamera, name: str) -> dict[str, str]:
    """Return suffix -> text of the files that ``cv::FileStorage`` and ROS read."""
    frame, (fx, fy, cx, cy), distortion = camera
    opencv = cv2.FileStorage(
        ".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    ros: dict[str, Any] = dict(zip(("image_width", "image_height"), frame, strict=True))
    for key, length in ros.items():
        opencv.write(key, length)
    ros |= {"camera_name": name,
            "distortion_model": "plumb_bob" if len(distortion) == 5 else "rational_polynomial"}
    for key, rows in {
        "camera_matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        "distortion_coefficients": [distortion],
        "rectification_matrix": np.eye(3),
        "projection_matrix": [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]],
    }.items():
        matrix = np.array(rows, dtype=np.float64)
        opencv.write(key, matrix)
        ros[key] = {"rows": len(matrix), "cols": matrix.shape[1], "data": matrix.ravel().tolist()}
    return {".opencv.yml": str(opencv.releaseAndGetString()),
            ".ros.yaml": yaml.safe_dump(ros, sort_keys=False, default_flow_style=None)}


# --------------------------------------------------------------------------------------------------
# The truth of exported images: arrays over the scenes, and a row for each square of an image.

#: Columns of where the corners are on the target, in its frame.
PLACES = tuple(f"{axis}{corner}_m" for corner in range(4) for axis in "XYZ")

#: Columns of the rotation vector in rad and of the position in m.
POSE = (*VECTOR, *POSITION)


class Truth(NamedTuple):
    """Truth of N scenes: arrays (N, ...) by name; tables of their squares and chessboards.

    The tables have the squares, and the inner corners of chessboards by OpenCV's numbers, of scenes
    with an image. The column ``camera`` of squares has a :class:`FileCamera`.
    """

    arrays: dict[str, NDArray[Any]]
    squares: pd.DataFrame
    chessboards: pd.DataFrame


def _columns(names: Sequence[str], values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of values (N, ...) by name."""
    return dict(zip(names, values.reshape(-1, len(names)).T, strict=True))


def truth_of(images: Images) -> Truth:
    """Return the truth of images."""
    batch, first = images.batch, images.windows[:, :2]
    scenes, targets, experiment = batch.scenes, batch.targets, batch.experiment
    drawn = {each.name: batch.values[each.drawn_as].broadcast(len(first))  # noqa: PD011
             for each in experiment.drawn}
    arrays: dict[str, Any] = {
        **{name: function(scenes) for name, function in GEOMETRY.items()},
        "marker_area_px": target_areas_px(scenes, targets),
        "image": np.where(batch.visible, images.names, "").astype(object),
        "true_corners_px": (
            targets.corners_px[:, 0] if targets.targets.are_markers else targets.corners_px),
        **drawn,
    }
    view = scenes.cameras.view
    of_image = pd.DataFrame({
        **_columns(POSE, np.hstack([arrays["true_rvec"], scenes.translation])),
        "size_m": scenes.size_m,
        **_columns(("width_px", "height_px"), images.windows[:, 2:] - first),
        **_columns(("origin_x_px", "origin_y_px"), first),
        **_columns(("fx_px", "fy_px"), view[:, :2]),
        **_columns(("cx_px", "cy_px"), view[:, 2:] - first),
        "camera": [camera_of(scenes, row) for row in range(len(first))],
        "marker_area_px": arrays["marker_area_px"],
    })
    varying = {
        name: [label(v) if isinstance(v := values[k], tuple) else v for k in along.tolist()]
        for axis, along in zip(experiment.scene_axes, batch.indices, strict=True)
        for name, values in axis.columns.items()
    } | drawn
    of_image = of_image.assign(**{
        name: varying[name] for name in varying
        if name not in (*of_image, "image", "marker_id", "dictionary")})
    row, square = np.nonzero(batch.visible[:, None] & (targets.marker_id >= 0))
    places = [
        targets.targets[i].corners_m[k]
        * (scenes.size_m[i] if targets.targets[i].is_marker else 1.0)
        for i, k in zip(row.tolist(), square.tolist(), strict=True)
    ]
    squares = pd.DataFrame({
        "image": arrays["image"][row], "id": targets.marker_id[row, square],
        "dictionary": [targets.targets[i].dictionary for i in row.tolist()],
        **_columns(CORNER_COLUMNS, targets.corners_px[row, square] - first[row, None]),
        "visible": (targets.flags[row, square] == DetectionStatus.not_run).astype(np.int64),
        **_columns(PLACES, np.array(places)),
    }).join(of_image.iloc[row].reset_index(drop=True))
    pixels = targets.chessboard_px - first[:, None]
    row, corner = np.nonzero(batch.visible[:, None] & np.isfinite(pixels[..., 0]))
    places = [targets.targets[i].chessboard_m[k]
              for i, k in zip(row.tolist(), corner.tolist(), strict=True)]
    chessboards = pd.DataFrame({
        "image": arrays["image"][row], "corner": corner,
        **_columns(("x", "y"), pixels[row, corner]),
        **_columns(("X_m", "Y_m", "Z_m"), np.array(places)),
    })
    return Truth(arrays, squares, chessboards)


def _dataset(pipeline: Pipeline, arrays: dict[str, NDArray[Any]]) -> xr.Dataset:
    """Return the truth over the experiment's scene axes, with the coordinates of a store."""
    axes = pipeline.experiment.scene_axes
    dims, shape = tuple(axis.name for axis in axes), tuple(len(axis) for axis in axes)
    corners = arrays["true_corners_px"]
    planned = [
        each for each in planned_arrays(pipeline, shape)
        if each.path in arrays
        or (each.values is not None  # noqa: PD011  (of an array that is planned)
            and {*each.dimensions} <= {*dims, "corner", "xy", "xyz"})
    ]
    variables: dict[str, Any] = {
        each.path: (each.dimensions, np.reshape(
            np.asarray(arrays.get(each.path, each.values)), each.shape), each.attributes)
        for each in planned
    }
    variables["image"] = (dims, arrays["image"].reshape(shape), {
        "long_name": "name of the image; empty where the target is not visible"})
    variables["true_corners_px"] = (
        (*dims, *("marker", "corner", "xy")[1 - corners.ndim:]),
        corners.reshape(shape + corners.shape[1:]),
        {"long_name": "true corners in the frame; pixel (0, 0) is the centre of the top left pixel",
         "units": "px"})
    return xr.Dataset(
        variables, attrs={"title": pipeline.heading, "pipeline": pipeline.text},
    ).set_coords([each.path for each in planned if each.coordinate or each.path not in arrays])


#: Description inside the COCO-like file.
COCO_INFO = {
    "description": "true corners of markers, as COCO keypoints",
    "pixel_center": 0,
    "corner_order": "top left, top right, bottom right, bottom left of the upright marker",
}


def _coco(squares: pd.DataFrame) -> dict[str, Any]:
    """Return rows of truth.csv as COCO keypoints; a category is a dictionary's marker."""
    points = squares[list(CORNER_COLUMNS)].to_numpy().reshape(-1, 4, 2)
    size = squares[["width_px", "height_px"]].to_numpy()[:, None]
    seen = ((points >= -0.5) & (points <= size - 0.5)).all(axis=2) & (
        squares[["visible"]].to_numpy() > 0)
    keypoints = np.dstack([points, 2 * seen]).reshape(-1, 12)  # COCO's 2: visible
    boxes, areas = np.hstack([points.min(axis=1), np.ptp(points, axis=1)]), signed_areas(points)
    images: dict[str, Any] = {}
    categories: dict[tuple[str, int], Any] = {}
    annotations = []
    for number, row in enumerate(squares.to_dict("records")):
        image = images.setdefault(row["image"], {
            "id": len(images), "file_name": f"images/{row['image']}",
            "width": row["width_px"], "height": row["height_px"]})
        category = categories.setdefault((row["dictionary"], row["id"]), {
            "id": len(categories) + 1, "name": f"{row['dictionary']} {row['id']}",
            "supercategory": row["dictionary"], "marker_id": row["id"],
            "keypoints": list(LABELS["corner"])})
        annotations.append({
            "id": number, "image_id": image["id"], "category_id": category["id"], "iscrowd": 0,
            "bbox": boxes[number].tolist(), "area": float(abs(areas[number])),
            "segmentation": points[number].reshape(1, 8).tolist(),
            "keypoints": keypoints[number].tolist(), "num_keypoints": int(seen[number].sum()),
            "rvec": [row[name] for name in VECTOR], "tvec_m": [row[name] for name in POSITION]})
    return {"info": COCO_INFO, "images": [*images.values()], "annotations": annotations,
            "categories": [*categories.values()]}


def write_truth(pipeline: Pipeline, folder: Path, truths: Sequence[Truth]) -> None:
    """Write the truth of an export's scenes, and their cameras."""
    arrays, squares, chessboards = zip(*truths, strict=True)
    table = pd.concat(squares, ignore_index=True)
    cameras = {camera: f"camera-{k}" for k, camera in enumerate(dict.fromkeys(table["camera"]))}
    table["camera"] = [cameras[camera] for camera in table["camera"]]
    chessboard = pd.concat(chessboards, ignore_index=True)
    for name, rows in (("truth", table), ("truth_chessboard", chessboard)):
        if len(rows) or rows is table:
            text = rows.to_csv(index=False, lineterminator="\n")
            write_whole(folder / f"{name}.csv", text.encode())
    write_whole(folder / "truth_coco.json", json.dumps(_coco(table)).encode())
    dataset = _dataset(pipeline, {
        name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]})
    write_whole(folder / "truth.nc", bytes(dataset.to_netcdf(engine="scipy")))
    (folder / "cameras").mkdir(exist_ok=True)
    for camera, name in cameras.items():
        for suffix, text in camera_files(camera, name).items():
            write_whole(folder / "cameras" / f"{name}{suffix}", text.encode())


# --------------------------------------------------------------------------------------------------
# Export of an experiment into a folder, which is continued.

#: The file by which a folder is known as an export; it names the experiment.
MARK = "export.json"

#: Digests of the images that are written, as ``sha256sum -c`` reads them.
CHECKSUMS = "images.sha256"

#: The README of an export: the folder's content, its conventions, and how answers come back.
GUIDE = Path(__file__).with_name("readme.md.jinja")

#: Folder of the pipeline and of the files that it names.
EXPERIMENT = "experiment"

#: Larger exports have to be confirmed.
MAX_BYTES = 10 * 10**9

#: Images by which the size of all is estimated.
SAMPLE = 8


@dataclass(frozen=True, slots=True)
class Export:
    """Result of an export.

    Attributes
    ----------
    folder
        Where it lies.
    images, invisible
        Scenes with an image, and scenes without: the marker is not visible, or the lens folds.
    written, kept, damaged
        Images that were written now; that were there; and of those written now, those of a
        finished export that were missing or had been changed.
    bytes
        Size of the images.
    """

    folder: str
    images: int
    invisible: int
    written: int
    kept: int
    damaged: int
    bytes: int


class ImageFile(NamedTuple):
    """An image of an export: its path and digest, its bytes, and whether it was written now."""

    name: str
    digest: str
    size: int
    written: bool


def export(
    pipeline: Pipeline,
    folder: str | Path,
    *,
    windowed: bool = False,
    workers: int | None = None,
    yes: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Export:
    """Write the images of an experiment, their truth and camera files into a folder.

    A folder with an unfinished export of the same experiment is continued: images are written
    whole, so that those that are there are done. Those of a finished one are rendered again, and
    what is missing or was changed is written.

    Parameters
    ----------
    pipeline
        The experiment.
    folder
        A new or empty folder, or one with an export of the same.
    windowed
        Whether images show the marker's surroundings, as a run searches them, instead of whole
        frames.
    workers
        Processes that render (default: this one).
    yes
        Export also what takes more than 10 GB, or more than is free on the disk.
    progress
        Called with the number of scenes that are done, and of all.

    Raises
    ------
    ArgumentError
        If ``workers`` is not from 1 to 1,000.
    StoreError
        If the folder holds something else, or cannot be written, or there is too much to write.
    RunError
        If an image cannot be rendered, or a process that renders is ended.
    """
    check_positive("workers", workers)
    target = Path(folder)
    count = len(pipeline.experiment.all_scenes)
    parts = [range(start, min(start + BATCH, count)) for start in range(0, count, BATCH)]
    pool = contextlib.nullcontext() if (workers or 1) == 1 else ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=end_with,
        initargs=(os.getpid(),))
    with translate_errors(plain(folder, 300), "written"), pool as processes:
        mark = _mark(pipeline, windowed)
        begun = _is_begun(target, mark)
        if not begun and not yes:
            _check_size(pipeline, target, count, windowed)
        (target / "images").mkdir(parents=True, exist_ok=True)
        if not begun:
            _write_experiment(pipeline, target)
            write_whole(target / MARK, json.dumps(mark, indent=2).encode() + b"\n")
        finished = (target / CHECKSUMS).exists()
        files, truths = list[ImageFile](), list[Truth]()
        work = functools.partial(write_images, pipeline, target, windowed, finished)
        try:
            for of_images, truth in (processes.map if processes else map)(work, parts):
                files += of_images
                truths.append(truth)
                if progress is not None:
                    progress(min(len(truths) * BATCH, count), count)
        except BrokenExecutor:
            raise RunError(f"{plain(target, 300)}: a process ended; use fewer workers") from None
        write_whole(target / CHECKSUMS, "".join(
            f"{each.digest}  {each.name}\n" for each in files).encode())
        write_truth(pipeline, target, truths)
        write_whole(target / "README.md", Template(GUIDE.read_text(encoding="utf-8")).render(
            title=pipeline.heading, images=len(files), invisible=count - len(files),
            windowed=windowed, target=pipeline.target_word,
        ).encode())
    written = sum(each.written for each in files)
    return Export(
        str(folder), len(files), count - len(files), written, len(files) - written,
        written * finished, sum(each.size for each in files))


def _is_begun(folder: Path, mark: dict[str, Any]) -> bool:
    """Return whether a folder holds an export with this mark, begun before; False if it is empty.

    Raises
    ------
    StoreError
        If it holds something else.
    """
    shown, begun = plain(folder, 300), read_mark(folder)
    if begun is None and (strange := sorted(path.name for path in folder.glob("*"))):
        raise StoreError(f"{shown}: holds {plain(strange[0])}, and no export; choose a new or an "
                         "empty folder")
    if begun is not None and begun != mark:
        raise StoreError("\n".join([
            f"{shown}: holds another export; choose another folder",
            *(f"  {key}: the folder has {plain(begun.get(key))}, this export {plain(mark.get(key))}"
              for key in sorted({*begun, *mark}) if begun.get(key) != mark.get(key))]))
    return begun is not None


def read_mark(folder: Path) -> dict[str, Any] | None:
    """Return the record in an export's folder; None if it is no export."""
    try:
        content = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and "sweep_export" in content else None


def _mark(pipeline: Pipeline, windowed: bool) -> dict[str, Any]:
    """Return the identity of an export: the experiment, the versions, the content of images."""
    return {
        "sweep_export": 1,  # the layout of the folder
        "name": pipeline.name,
        "pipeline": hashlib.sha256(pipeline.text.encode()).hexdigest()[:16],
        "images": "windows" if windowed else "whole frames",
        "fingerprint": json.loads(json.dumps(fingerprint(pipeline))),
        "sweep": environment()["sweep"],
    }


def _write_experiment(pipeline: Pipeline, folder: Path) -> None:
    """Write the pipeline, and copies of the files that it names by relative paths within."""
    home = folder / EXPERIMENT
    home.mkdir(exist_ok=True)
    for written in pipeline.files:
        path = Path(written.partition("#")[0])
        if path.is_absolute() or ".." in path.parts:
            continue
        copy = home / path
        copy.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            write_whole(copy, (Path(pipeline.folder) / path).read_bytes())
    write_whole(home / "pipeline.toml", pipeline.text.encode())


def write_images(
    pipeline: Pipeline, folder: Path, windowed: bool, finished: bool, numbers: range
) -> tuple[list[ImageFile], Truth]:
    """Write the images of scenes by their numbers that are missing; return all, and their truth.

    Images of an export that was ``finished`` are not believed: they are rendered again.

    Raises
    ------
    RunError
        If an image cannot be rendered.
    """
    images = images_of(pipeline, numbers, windowed=windowed)
    files = []
    for row in np.flatnonzero(images.batch.visible).tolist():
        name = f"images/{images.names[row]}"
        path = folder / name
        found = path.read_bytes() if path.exists() else None
        content = encoded_image(images, row) if found is None or finished else found
        if content != found:
            write_whole(path, content)
        digest = hashlib.sha256(content).hexdigest()
        files.append(ImageFile(name, digest, len(content), content != found))
    return files, truth_of(images)


def _check_size(pipeline: Pipeline, folder: Path, count: int, windowed: bool) -> None:
    """Refuse an export that is large, or more than fits: StoreError; by a sample of the images."""
    numbers = np.unique(np.linspace(0, count - 1, SAMPLE).astype(np.intp)).tolist()
    images = images_of(pipeline, numbers, windowed=windowed)
    sizes = [len(encoded_image(images, row))
             for row in np.flatnonzero(images.batch.visible).tolist()]
    total = int(count * np.mean(sizes)) if sizes else 0
    free = free_bytes(str(folder))
    if total > min(MAX_BYTES, free):
        raise StoreError(
            f"{plain(folder, 300)}: the export takes about {filesize.decimal(total)} in {count:,} "
            f"files, and {filesize.decimal(int(min(free, 1e18)))} are free; choose fewer scenes, "
            "windows, or confirm it with --yes (in Python, yes=True)")
