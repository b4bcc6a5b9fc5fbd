"""Sets of images for other programs, with their truth and their camera's files."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import xarray as xr
import yaml
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.evaluation.search import SceneBatch, common_windows, scenes_at, searched_windows
from sweep.evaluation.variables import GEOMETRY, target_areas_px
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.measure.flags import DetectionStatus
from sweep.messages import label, plain
from sweep.model.polygon import signed_areas
from sweep.model.scene import Scenes
from sweep.store.files import write_whole
from sweep.store.lifecycle import planned_arrays
from sweep.store.locations import reason_of
from sweep.typing import Integers

# --------------------------------------------------------------------------------------------------
# An experiment's scenes as a set of images: their numbers, names, windows, and visibility.

BATCH = 256
"""Scenes that are in memory together."""


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

    A window is the smallest that holds those of all detector settings of the experiment.
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

MODELS = {5: "plumb_bob", 8: "rational_polynomial"}
"""Coefficients -> ROS's name of the lens model; longer ones are rational polynomials, too."""


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

CORNERS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
"""Columns of the corners: x0, y0 of the top left one, then clockwise on the marker."""

PLACES = tuple(f"{axis}{corner}_m" for corner in range(4) for axis in "XYZ")
"""Columns of where the corners are on the target, in its frame."""

POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Columns of the rotation vector in rad and of the position in m."""


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


COCO_INFO = {
    "description": "true corners of markers, as COCO keypoints",
    "pixel_center": 0,
    "corner_order": "top left, top right, bottom right, bottom left of the upright marker",
}
"""What the COCO-like file says of itself."""


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
