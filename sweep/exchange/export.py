"""Export of an experiment: its images, their truth, and camera files, in a folder."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import multiprocessing
import re
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
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

from sweep.errors import ArgumentError, RunError, StoreError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SceneBatch, common_windows, scenes_at, searched_windows
from sweep.evaluation.variables import GEOMETRY, target_areas_px
from sweep.execution.forecast import free_disk
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.measure.flags import DetectionStatus
from sweep.messages import byte_count, label, plain
from sweep.model.polygon import signed_areas
from sweep.model.renderers import render
from sweep.model.scene import Scenes
from sweep.store.files import write_whole
from sweep.store.lifecycle import planned_arrays
from sweep.store.locations import reason_of
from sweep.store.provenance import environment, fingerprint
from sweep.typing import Integers

# --------------------------------------------------------------------------------------------------
# An experiment's scenes as a set of images: their numbers, names, windows, and visibility.

#: Scenes that are in memory together.
BATCH = 256


@dataclass(frozen=True, slots=True)
class ImageBatch(SceneBatch):
    """N scenes of an experiment as images, with their names.

    There is an image of each visible scene: its target is in the frame, and the lens model holds
    there.

    Attributes
    ----------
    numbers
        (N,) places in the grid of scene axes, the last axis fastest.
    keys
        (N,) keys of the images (:func:`sweep.experiment.experiment.Experiment.image_keys`).
    windows
        (N, 4) left, top, right, bottom in pixels of the frame, half-open: the part of the frame
        that the image shows.
    """

    numbers: NDArray[np.intp]
    keys: NDArray[np.uint64]
    windows: Integers

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def names(self) -> list[str]:
        """The images' names without a suffix: a number, which sorts, and half a key."""
        return [
            f"{number:06d}-{key & 0xFFFFFFFF:08x}"
            for number, key in zip(self.numbers.tolist(), self.keys.tolist(), strict=True)
        ]


def image_batch(
    pipeline: Pipeline, numbers: NDArray[np.intp], *, windowed: bool = False
) -> ImageBatch:
    """Return scenes by their numbers (N,); ``windowed``: images of the target's surroundings.

    A window is the smallest that holds the windows of all detector settings of the experiment.
    """
    indices = pipeline.experiment.all_scenes.indices(numbers)
    batch = scenes_at(pipeline.experiment, indices)
    frame = batch.scenes.frame
    return ImageBatch(
        **{field.name: getattr(batch, field.name) for field in dataclasses.fields(batch)},
        numbers=np.asarray(numbers),
        keys=pipeline.experiment.image_keys(indices),
        windows=common_windows(searched_windows(batch)) if windowed
        else np.concatenate([np.zeros_like(frame), frame], axis=1),
    )


def image_batches(pipeline: Pipeline, *, windowed: bool = False) -> Iterator[ImageBatch]:
    """Yield all scenes of an experiment, in the order of their numbers."""
    count = len(pipeline.experiment.all_scenes)
    for start in range(0, count, BATCH):
        numbers = np.arange(start, min(start + BATCH, count), dtype=np.intp)
        yield image_batch(pipeline, numbers, windowed=windowed)


# --------------------------------------------------------------------------------------------------
# Camera files for other programs: OpenCV's FileStorage and ROS's camera_info.
#
# Both put pixel (0, 0) at the centre of the top left pixel and have OpenCV's lens model, as the
# simulation does.

#: Coefficients -> ROS's name of the lens model; longer ones are rational polynomials, too.
MODELS = {5: "plumb_bob", 8: "rational_polynomial"}


@dataclass(frozen=True, slots=True)
class FileCamera:
    """A camera as files have it: frame in pixels, fx, fy, cx, cy in px, and coefficients."""

    width_px: int
    height_px: int
    view: tuple[float, float, float, float]
    distortion: tuple[float, ...]

    @staticmethod
    def of(scenes: Scenes, row: int) -> FileCamera:
        """Return the camera of a scene, with 5, 8, 12 or 14 coefficients."""
        width, height = scenes.frame[row].tolist()
        fx, fy, cx, cy = scenes.cameras.view[row].tolist()
        coefficients = scenes.cameras.lenses[row, :14].tolist()
        used = int(np.max(np.flatnonzero(coefficients), initial=-1)) + 1
        count = next(length for length in (5, 8, 12, 14) if length >= used)
        return FileCamera(width, height, (fx, fy, cx, cy), tuple(coefficients[:count]))

    @property
    def matrix(self) -> list[float]:
        """The camera matrix, row by row."""
        fx, fy, cx, cy = self.view
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]

    def opencv_yaml(self) -> str:
        """Return the text of a file that ``cv::FileStorage`` reads."""
        file = cv2.FileStorage(
            ".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
        )
        file.write("image_width", self.width_px)
        file.write("image_height", self.height_px)
        file.write("camera_matrix", np.reshape(self.matrix, (3, 3)))
        file.write("distortion_coefficients", np.array([self.distortion]))
        return str(file.releaseAndGetString())

    def ros_yaml(self, name: str) -> str:
        """Return the text of a ``camera_info`` file as ROS's camera_calibration writes it."""
        fx, fy, cx, cy = self.view
        matrices = {
            "camera_matrix": (3, self.matrix),
            "distortion_coefficients": (1, list(self.distortion)),
            "rectification_matrix": (3, np.eye(3).ravel().tolist()),
            "projection_matrix": (
                3, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
            ),
        }
        return str(yaml.safe_dump({
            "image_width": self.width_px, "image_height": self.height_px, "camera_name": name,
            "distortion_model": MODELS.get(len(self.distortion), "rational_polynomial"),
            **{key: {"rows": rows, "cols": len(values) // rows, "data": values}
               for key, (rows, values) in matrices.items()},
        }, sort_keys=False, default_flow_style=None))


# --------------------------------------------------------------------------------------------------
# The truth of exported images: rows of CSV, COCO records, and the variables of a dataset.

#: Columns of the corners: x0, y0 of the top left one, then clockwise on the marker.
CORNERS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")

#: Columns of where the corners are on the target, in its frame.
PLACES = tuple(f"{axis}{corner}_m" for corner in range(4) for axis in "XYZ")

#: Columns of the rotation vector in rad and of the position in m.
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")


def write_truth(
    pipeline: Pipeline, folder: Path, *, windowed: bool
) -> tuple[dict[FileCamera, str], int, int]:
    """Write ``truth.csv``, ``truth_coco.json`` and ``truth.nc`` of an export's images.

    Of targets with a chessboard ``truth_chessboard.csv``, too.

    Returns
    -------
    The cameras' names, in order of appearance; the number of scenes with an image, and of those
    without.
    """
    columns: dict[str, list[Any]] = {}
    cameras: dict[FileCamera, str] = {}
    tables: list[pd.DataFrame] = []
    chessboards: list[pd.DataFrame] = []
    for batch in image_batches(pipeline, windowed=windowed):
        scenes, targets = batch.scenes, batch.targets
        drawn_values = batch.values  # noqa: PD011  (of scenes, not of a table)
        of_batch: dict[str, Any] = {
            **{name: function(scenes) for name, function in GEOMETRY.items()},
            "marker_area_px": target_areas_px(scenes, targets),
            "image": np.where(
                batch.visible, [f"{name}.png" for name in batch.names], "").astype(object),
            "true_corners_px": (
                targets.corners_px[:, 0] if targets.targets.are_markers else targets.corners_px
            ),
            **{each.name: drawn_values[each.drawn_as].broadcast(len(batch))
               for each in pipeline.experiment.drawn},
        }
        for name, values in of_batch.items():
            columns.setdefault(name, []).append(values)
        of_images = _of_images(pipeline, batch, of_batch, cameras)
        tables.append(_of_squares(batch, of_images))
        chessboards.append(_of_chessboards(batch, of_images))
    table, chessboard = (pd.concat(parts, ignore_index=True) for parts in (tables, chessboards))
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    write_whole(folder / "truth.csv", _csv(table))
    if len(chessboard):
        write_whole(folder / "truth_chessboard.csv", _csv(chessboard))
    write_whole(folder / "truth_coco.json", json.dumps(_coco(table)).encode())
    write_whole(folder / "truth.nc", bytes(_dataset(pipeline, whole).to_netcdf(engine="scipy")))
    images = int((whole["image"] != "").sum())
    return cameras, images, len(whole["image"]) - images


def _of_images(
    pipeline: Pipeline, batch: ImageBatch, variables: dict[str, Any], cameras: dict[FileCamera, str]
) -> pd.DataFrame:
    """Return a row an image of a batch with these variables, and note its cameras."""
    scenes, experiment = batch.scenes, pipeline.experiment
    first, last = batch.windows[:, :2], batch.windows[:, 2:]
    view = scenes.cameras.view
    names = [
        cameras.setdefault(FileCamera.of(scenes, row), f"camera-{len(cameras)}") if visible else ""
        for row, visible in enumerate(batch.visible.tolist())
    ]
    pose = np.column_stack([variables["true_rvec"], scenes.translation, scenes.size_m])
    table = pd.DataFrame({
        "image": variables["image"],
        **dict(zip((*POSE, "size_m"), pose.T, strict=True)),
        **dict(zip(("width_px", "height_px"), (last - first).T, strict=True)),
        **dict(zip(("origin_x_px", "origin_y_px"), first.T, strict=True)),
        **dict(zip(("fx_px", "fy_px"), view[:, :2].T, strict=True)),
        **dict(zip(("cx_px", "cy_px"), (view[:, 2:] - first).T, strict=True)),
        "camera": names, "marker_area_px": variables["marker_area_px"],
    })
    indices = experiment.all_scenes.indices(batch.numbers)
    for axis, along in zip(experiment.scene_axes, indices, strict=True):
        for name, values in axis.columns.items():
            if name not in (*table, "marker_id", "dictionary"):
                labels = [label(v) if isinstance(v, tuple) else v for v in values]
                table[name] = [labels[k] for k in along.tolist()]
    for each in experiment.drawn:
        if each.name not in table:
            table[each.name] = variables[each.name]
    return table


def _dataset(pipeline: Pipeline, columns: dict[str, NDArray[Any]]) -> xr.Dataset:
    """Return the truth over the experiment's scene axes."""
    axes = pipeline.experiment.scene_axes
    dims, shape = tuple(axis.name for axis in axes), tuple(len(axis) for axis in axes)
    drawn = {each.name: each for each in pipeline.experiment.drawn}
    described = {name: VARIABLES[name] for name in (*GEOMETRY, "marker_area_px")}
    inner = {name: each.inner for name, each in described.items()}
    inner["true_corners_px"] = ("marker", "corner", "xy")[-columns["true_corners_px"].ndim + 1:]
    attributes = {name: each.attributes() for name, each in (described | drawn).items()} | {
        "true_corners_px": {
            "long_name": "true corners in the frame; pixel (0, 0) is the centre of the top "
            "left pixel", "units": "px"},
        "image": {"long_name": "name of the image; empty where the target is not visible"},
    }
    variables: dict[str, Any] = {
        name: (dims + inner.get(name, ()), values.reshape(shape + values.shape[1:]),
               attributes[name])
        for name, values in columns.items()
    }
    coordinates: dict[str, Any] = {
        each.path: (each.dimensions, _plain(each.values), each.attributes)
        for each in planned_arrays(pipeline, shape)
        if each.values is not None  # noqa: PD011  (of an array that is planned)
        and {*each.dimensions} <= {*dims, "corner", "xy", "xyz"}
    } | {name: variables.pop(name) for name in drawn}
    return xr.Dataset(
        variables, coordinates, {"title": pipeline.heading, "pipeline": pipeline.text})


def _plain(values: Any) -> Any:
    """Return coordinates in types that netCDF has."""
    return values.astype(np.int8) if values.dtype.kind == "b" else values


def _csv(table: pd.DataFrame) -> bytes:
    return str(table.to_csv(index=False, lineterminator="\n")).encode()


def _repeated(table: pd.DataFrame, rows: Integers, own: dict[str, Any]) -> pd.DataFrame:
    """Return rows of a table with columns of their own behind the first, the image's name."""
    chosen = table.iloc[rows].reset_index(drop=True)
    return pd.concat([chosen[["image"]], pd.DataFrame(own), chosen.iloc[:, 1:]], axis=1)


def _of_squares(batch: ImageBatch, images: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each square of each image's target."""
    scenes, targets = batch.scenes, batch.targets
    row, square = np.nonzero(batch.visible[:, None] & (targets.marker_id >= 0))
    corners = targets.corners_px[row, square] - batch.windows[row, None, :2]
    places = [
        targets.targets[i].corners_m[k]
        * (scenes.size_m[i] if targets.targets[i].is_marker else 1.0)
        for i, k in zip(row.tolist(), square.tolist(), strict=True)
    ]
    return _repeated(images, row, {
        "id": targets.marker_id[row, square],
        "dictionary": [targets.targets[i].dictionary for i in row.tolist()],
        **dict(zip(CORNERS, corners.reshape(-1, 8).T, strict=True)),
        "visible": (targets.flags[row, square] == DetectionStatus.not_run).astype(np.int64),
        **dict(zip(PLACES, np.reshape(places, (-1, 12)).T, strict=True)),
    })


def _of_chessboards(batch: ImageBatch, images: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each inner corner of each image's chessboard, by OpenCV's numbers."""
    pixels = batch.targets.chessboard_px - batch.windows[:, None, :2]
    row, corner = np.nonzero(batch.visible[:, None] & np.isfinite(pixels[..., 0]))
    places = [
        batch.targets.targets[i].chessboard_m[k]
        for i, k in zip(row.tolist(), corner.tolist(), strict=True)
    ]
    return _repeated(images.loc[:, ["image"]], row, {
        "corner": corner,
        **dict(zip(("x", "y"), pixels[row, corner].T, strict=True)),
        **dict(zip(("X_m", "Y_m", "Z_m"), np.reshape(places, (-1, 3)).T, strict=True)),
    })


#: Description inside the COCO-like file.
COCO_INFO = {
    "description": "true corners of markers, as COCO keypoints",
    "pixel_center": 0,
    "corner_order": "top left, top right, bottom right, bottom left of the upright marker",
}


def _coco(table: pd.DataFrame) -> dict[str, Any]:
    """Return rows of truth.csv as COCO keypoints; a category is a dictionary's marker."""
    images = table.drop_duplicates("image")
    markers = table.drop_duplicates(["dictionary", "id"])
    image_of = dict(zip(images["image"], range(len(images)), strict=True))
    category_of = {each: number for number, each in enumerate(
        zip(markers["dictionary"], markers["id"], strict=True), 1)}
    points = table[list(CORNERS)].to_numpy().reshape(-1, 4, 2)
    size = table[["width_px", "height_px"]].to_numpy()[:, None]
    seen = ((points >= -0.5) & (points <= size - 0.5)).all(axis=2) & (
        table[["visible"]].to_numpy() > 0)
    boxes = np.concatenate([points.min(axis=1), np.ptp(points, axis=1)], axis=1)
    pose = table[list(POSE)].to_numpy()
    return {
        "info": COCO_INFO,
        "images": [
            {"id": image_of[name], "file_name": f"images/{name}", "width": width, "height": height}
            for name, width, height in images[["image", "width_px", "height_px"]].itertuples(
                index=False)
        ],
        "annotations": [
            {"id": k, "image_id": image_of[name], "category_id": category_of[dictionary, marker],
             "iscrowd": 0, "bbox": boxes[k].tolist(), "area": area,
             "segmentation": [points[k].ravel().tolist()],
             # COCO's 2: visible.
             "keypoints": np.column_stack([points[k], 2 * seen[k]]).ravel().tolist(),
             "num_keypoints": int(seen[k].sum()),
             "rvec": pose[k, :3].tolist(), "tvec_m": pose[k, 3:].tolist()}
            for k, (name, dictionary, marker, area) in enumerate(zip(
                table["image"], table["dictionary"], table["id"],
                np.abs(signed_areas(points)).tolist(), strict=True))
        ],
        "categories": [
            {"id": number, "name": f"{dictionary} {marker}", "supercategory": dictionary,
             "marker_id": marker, "keypoints": list(LABELS["corner"])}
            for (dictionary, marker), number in category_of.items()
        ],
    }


# --------------------------------------------------------------------------------------------------
# Errors of writing an export or a recording, in words for the user.

@contextlib.contextmanager
def write_errors(folder: Path) -> Iterator[None]:
    """Turn the system's errors into a StoreError that names the folder."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{plain(error.filename or folder, 300)}: cannot be written: {reason_of(error)}; the "
            "same command continues"
        ) from None


# --------------------------------------------------------------------------------------------------
# Export of an experiment: its images, their truth, and camera files, in a folder.

#: The file by which a folder is known as an export; it names the experiment.
MARK = "export.json"

#: Digests of the images that are written, as ``sha256sum -c`` reads them.
CHECKSUMS = "images.sha256"

#: The README of an export: the folder's content, its conventions, and how answers come back.
GUIDE = Path(__file__).with_name("readme.md.jinja")

#: Folder of the pipeline and of the files that it names.
EXPERIMENT = "experiment"

FORMAT = 1

#: Larger exports have to be confirmed.
MAX_BYTES = 10 * 10**9

#: Larger experiments are not exported: their names are listed in memory.
MAX_SCENES = 10**6

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
        Images that were rendered now; that were there; and of those rendered now, those that an
        earlier export had listed, and that were missing or had been changed.
    bytes
        Size of the images.
    cameras
        Distinct cameras.
    seconds
        How long it took.
    """

    folder: str
    images: int
    invisible: int
    written: int
    kept: int
    damaged: int
    bytes: int
    cameras: int
    seconds: float


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
    whole, so that those that are there are done, unless a finished export listed other digests.

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
        If ``workers`` is below 1.
    StoreError
        If the folder holds something else, or cannot be written, or there is too much to write.
    RunError
        If an image cannot be rendered.
    """
    started = time.perf_counter()
    if workers is not None and workers < 1:
        raise ArgumentError("workers", workers, "expected at least 1")
    target = Path(folder)
    count = len(pipeline.experiment.all_scenes)
    if count > MAX_SCENES:
        raise StoreError(
            f"{plain(target, 300)}: {count:,} scenes; at most {MAX_SCENES:,} are exported; choose "
            "some with --set, or export in parts"
        )
    with write_errors(target):
        mark = _mark(pipeline, windowed)
        begun = check_folder(target, mark)
        if not begun and not yes:
            _check_size(pipeline, target, count, windowed)
        (target / "images").mkdir(parents=True, exist_ok=True)
        if not begun:
            _write_experiment(pipeline, target)
            write_whole(target / MARK, json.dumps(mark, indent=2).encode() + b"\n")
        damaged = _remove_changed(target)
        digests: dict[str, str] = {}
        written = size = done = 0
        for part in _rendered_parts(pipeline, target, windowed, workers):
            digests |= part.digests
            written += part.written
            size += part.bytes
            done += part.scenes
            if progress is not None:
                progress(done, count)
        write_whole(target / CHECKSUMS, "".join(
            f"{digest}  {name}\n" for name, digest in sorted(digests.items())).encode())
        cameras, images, invisible = write_truth(pipeline, target, windowed=windowed)
        (target / "cameras").mkdir(exist_ok=True)
        for camera, name in cameras.items():
            path = target / "cameras" / name
            write_whole(path.with_suffix(".opencv.yml"), camera.opencv_yaml().encode())
            write_whole(path.with_suffix(".ros.yaml"), camera.ros_yaml(name).encode())
        write_whole(target / "README.md", Template(GUIDE.read_text(encoding="utf-8")).render(
            title=pipeline.heading, images=images, invisible=invisible,
            windowed=windowed, target=pipeline.target_word,
        ).encode())
    return Export(
        str(folder), images, invisible, written, len(digests) - written, damaged, size,
        len(cameras), time.perf_counter() - started,
    )


def check_folder(folder: Path, mark: dict[str, Any]) -> bool:
    """Return whether a folder holds an export with this mark, begun before; False if it is empty.

    Raises
    ------
    StoreError
        If it holds something else.
    """
    shown = plain(folder, 300)
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise StoreError(f"{shown}: a file; choose a new folder")
    begun = read_mark(folder)
    if begun is None:
        strange = next((path.name for path in sorted(folder.iterdir())), None)
        if strange is None:
            return False
        raise StoreError(
            f"{shown}: holds {plain(strange)}, and no export; choose a new or an empty folder"
        )
    if begun == mark:
        return True
    lines = [
        f"  {key}: the folder has {plain(begun.get(key))}, this export {plain(mark.get(key))}"
        for key in sorted({*begun, *mark}) if begun.get(key) != mark.get(key)
    ]
    raise StoreError("\n".join([
        f"{shown}: holds another export; choose another folder", *lines,
    ]))


def read_mark(folder: Path) -> dict[str, Any] | None:
    """Return the record in an export's folder; None if it is no export."""
    try:
        content = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and "sweep_export" in content else None


def _mark(pipeline: Pipeline, windowed: bool) -> dict[str, Any]:
    """Return the identity of an export: the experiment, the versions, the content of images."""
    made_by = fingerprint(pipeline)
    return {
        "sweep_export": FORMAT,
        "name": pipeline.name,
        "pipeline": hashlib.sha256(pipeline.text.encode()).hexdigest()[:16],
        "images": "windows" if windowed else "whole frames",
        "fingerprint": json.loads(json.dumps(made_by)),
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


def _remove_changed(folder: Path) -> int:
    """Delete the images that differ from the digests of an export that was finished here.

    Returns how many of the listed images were missing or had been changed.
    """
    try:
        text = (folder / CHECKSUMS).read_text(encoding="utf-8")
    except (FileNotFoundError, ValueError):
        return 0
    count = 0
    for digest, name in re.findall(r"^([0-9a-f]{64})  (images/[^/\n]+)$", text, re.MULTILINE):
        path = folder / name
        if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            path.unlink(missing_ok=True)
            count += 1
    return count


class _Part(NamedTuple):
    """Result of a run of scenes: its images' paths and digests, counts, and bytes."""

    digests: dict[str, str]
    scenes: int
    written: int
    bytes: int


def _rendered_parts(
    pipeline: Pipeline, folder: Path, windowed: bool, workers: int | None
) -> Iterator[_Part]:
    """Yield the parts of an export, in this process or from several."""
    count = len(pipeline.experiment.all_scenes)
    parts = [range(start, min(start + BATCH, count)) for start in range(0, count, BATCH)]
    work = functools.partial(write_images, pipeline, folder, windowed)
    if workers is None or workers == 1 or len(parts) == 1:
        yield from map(work, parts)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(work, parts)


def write_images(pipeline: Pipeline, folder: Path, windowed: bool, numbers: range) -> _Part:
    """Write the images of scenes by their numbers that are missing.

    Raises
    ------
    RunError
        If an image cannot be rendered.
    """
    batch = image_batch(pipeline, np.array(numbers, dtype=np.intp), windowed=windowed)
    names = batch.names
    digests = {}
    written = size = 0
    for row in np.flatnonzero(batch.visible).tolist():
        name = f"images/{names[row]}.png"
        path = folder / name
        if path.exists():
            content = path.read_bytes()
        else:
            content = encoded_image(batch, row)
            write_whole(path, content)
            written += 1
        digests[name] = hashlib.sha256(content).hexdigest()
        size += len(content)
    return _Part(digests, len(numbers), written, size)


def encoded_image(batch: ImageBatch, row: int) -> bytes:
    """Return a scene's image as PNG; RunError if it cannot be rendered."""
    try:
        with single_threaded():
            x0, y0, x1, y1 = batch.windows[row].tolist()
            image = render(batch.scenes, row, batch.boxes[row], (x0, y0, x1, y1))
            _, encoded = cv2.imencode(".png", image)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError, cv2.error) as error:
        raise RunError(f"image {batch.names[row]}: {plain(error, 300)}") from None
    return bytes(encoded.tobytes())


def _check_size(pipeline: Pipeline, folder: Path, count: int, windowed: bool) -> None:
    """Refuse an export that is large, or more than fits: StoreError; by a sample of the images."""
    numbers = np.unique(np.linspace(0, count - 1, SAMPLE).astype(np.intp))
    batch = image_batch(pipeline, numbers, windowed=windowed)
    sizes: Sequence[int] = [
        len(encoded_image(batch, row)) for row in np.flatnonzero(batch.visible).tolist()
    ]
    # A file takes whole pages of the disk.
    total = int(count * (np.mean([-(-size // 4096) * 4096 for size in sizes]) if sizes else 0))
    free = free_disk(str(folder))
    found = []
    if total > MAX_BYTES:
        found.append(f"takes about {byte_count(total)}")
    if free is not None and total > free.bytes:
        found.append(f"takes about {byte_count(total)}, and {byte_count(free.bytes)} are free")
    if free is not None and free.files is not None and count > free.files:
        found.append(f"makes {count:,} files, and the disk has room for {free.files:,}")
    if found:
        raise StoreError(
            f"{plain(folder, 300)}: the export {' and '.join(dict.fromkeys(found[-1:]))}; choose "
            "fewer scenes, windows, or confirm it with --yes (in Python, yes=True)"
        )
