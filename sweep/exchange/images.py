"""Sets of images for other programs, with their truth and their camera's files."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.evaluation.block import GEOMETRY
from sweep.evaluation.search import search_windows, visibility_flags, whole_frames
from sweep.experiment.experiment import scene_plugins
from sweep.experiment.grid import detector_settings, image_keys, scene_axes, scene_values
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LABELS, VARIABLES, drawn_variables
from sweep.measure.flags import DetectionStatus
from sweep.messages import label, plain
from sweep.model.camera import Column
from sweep.model.extent import marker_boxes
from sweep.model.pose import vector_of_rotation
from sweep.model.scene import Scenes, build_scenes
from sweep.store.files import write_whole
from sweep.store.locations import reason_of
from sweep.typing import Integers, Masks

# --------------------------------------------------------------------------------------------------
# An experiment's scenes as a set of images: their numbers, names, windows, and visibility.

BATCH = 256
"""Scenes that are in memory together."""


@dataclass(frozen=True, slots=True)
class ImageBatch:
    """N scenes of an experiment and their images' names.

    Attributes
    ----------
    numbers
        (N,) places in the grid of scene axes, the last axis fastest.
    keys
        (N,) keys of the images (:func:`sweep.experiment.grid.image_keys`).
    values, scenes
        Parameters and geometry.
    visible
        (N,) whether there is an image: the marker is in the frame, and the lens model holds there.
    boxes, windows
        (N, 4) left, top, right, bottom in pixels of the frame, half-open: what the marker can
        touch, and the part of the frame that the image shows.
    """

    numbers: NDArray[np.intp]
    keys: NDArray[np.uint64]
    values: dict[str, Column]
    scenes: Scenes
    visible: Masks
    boxes: Integers
    windows: Integers

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def names(self) -> list[str]:
        """The images' names without a suffix."""
        return [
            image_name(number, key)
            for number, key in zip(self.numbers.tolist(), self.keys.tolist(), strict=True)
        ]


def image_name(number: int, key: int) -> str:
    """Return the name of an image: its number, which sorts, and half its key, which identifies.

    >>> image_name(12, 0x0123456789ABCDEF)
    '000012-89abcdef'
    """
    return f"{number:06d}-{key & 0xFFFFFFFF:08x}"


def scene_count(pipeline: Pipeline) -> int:
    """Return the number of scenes of an experiment."""
    return math.prod(len(axis) for axis in scene_axes(pipeline))


def scene_indices(pipeline: Pipeline, numbers: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the indices (N,) along each scene axis of scenes by their numbers (N,)."""
    lengths = tuple(len(axis) for axis in scene_axes(pipeline))
    return [np.asarray(index) for index in np.unravel_index(numbers, lengths)] if lengths else []


def image_batch(
    pipeline: Pipeline, numbers: NDArray[np.intp], *, windowed: bool = False
) -> ImageBatch:
    """Return scenes by their numbers (N,); ``windowed``: images of the marker's surroundings.

    A window is the smallest that holds those of all detector settings of the experiment.
    """
    indices = scene_indices(pipeline, numbers)
    count = len(numbers)
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count, scene_plugins(pipeline))
    visible = visibility_flags(scenes) == DetectionStatus.not_run
    boxes = marker_boxes(scenes)
    frames = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    windows = frames
    if windowed:
        full = whole_frames(values, count)
        cut = [
            search_windows(scenes, boxes, setting, full) for setting in detector_settings(pipeline)
        ]
        windows = np.concatenate([
            np.min([each[:, :2] for each in cut], axis=0),
            np.max([each[:, 2:] for each in cut], axis=0),
        ], axis=1)
    return ImageBatch(
        np.asarray(numbers), image_keys(pipeline, indices), values, scenes, visible, boxes, windows
    )


def image_batches(pipeline: Pipeline, *, windowed: bool = False) -> Iterator[ImageBatch]:
    """Yield all scenes of an experiment, in the order of their numbers."""
    count = scene_count(pipeline)
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
        return "\n".join([
            "%YAML:1.0", "---",
            f"image_width: {self.width_px}", f"image_height: {self.height_px}",
            *_opencv_matrix("camera_matrix", 3, self.matrix),
            *_opencv_matrix("distortion_coefficients", 1, self.distortion), "",
        ])

    def ros_yaml(self, name: str) -> str:
        """Return the text of a ``camera_info`` file as ROS's camera_calibration writes it."""
        fx, fy, cx, cy = self.view
        model = MODELS.get(len(self.distortion), "rational_polynomial")
        return "\n".join([
            f"image_width: {self.width_px}", f"image_height: {self.height_px}",
            f"camera_name: {name}",
            *_ros_matrix("camera_matrix", 3, self.matrix),
            f"distortion_model: {model}",
            *_ros_matrix("distortion_coefficients", 1, self.distortion),
            *_ros_matrix("rectification_matrix", 3, np.eye(3).ravel().tolist()),
            *_ros_matrix(
                "projection_matrix", 3,
                [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            ), "",
        ])


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _opencv_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    return [
        f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {len(values) // rows}",
        "   dt: d", f"   data: {_numbers(values)}",
    ]


def _ros_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(values) // rows}",
            f"  data: {_numbers(values)}"]


# --------------------------------------------------------------------------------------------------
# The truth of exported images: a CSV row, COCO records, and the variables of a dataset.

CORNERS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
"""Columns of the corners: x0, y0 of the top left one, then clockwise on the marker."""

POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Columns of the rotation vector in rad and of the position in m."""


@dataclass(slots=True)
class TruthTables:
    """Tables of the truth of an export's images.

    Attributes
    ----------
    pipeline, windowed
        What is exported.
    cameras
        Camera -> its name, in order of appearance.
    images, invisible
        Scenes with an image, and those without.
    """

    pipeline: Pipeline
    windowed: bool
    cameras: dict[FileCamera, str] = field(default_factory=dict)
    images: int = 0
    invisible: int = 0

    def write(self, folder: Path) -> None:
        """Write ``truth.csv``, ``truth_coco.json`` and ``truth.nc`` into a folder."""
        columns: dict[str, list[Any]] = {name: [] for name in (*GEOMETRY, "true_corners_px")}
        drawn = drawn_variables(self.pipeline)
        columns |= {each.name: [] for each in drawn}
        names: list[str] = []
        tables: list[pd.DataFrame] = []
        for batch in image_batches(self.pipeline, windowed=self.windowed):
            for name, function in GEOMETRY.items():
                columns[name].append(function(batch.scenes))
            columns["true_corners_px"].append(batch.scenes.corners_px)
            values = batch.values  # noqa: PD011  (of scenes, not of a table)
            for each in drawn:
                columns[each.name].append(values[each.drawn_as].broadcast(len(batch)))
            names += np.where(batch.visible, [f"{name}.png" for name in batch.names], "").tolist()
            tables.append(self._rows(batch, {name: parts[-1] for name, parts in columns.items()}))
        table = pd.concat(tables, ignore_index=True)
        self.images, self.invisible = len(table), len(names) - len(table)
        write_whole(folder / "truth.csv", table.to_csv(index=False, lineterminator="\n").encode())
        write_whole(folder / "truth_coco.json", _coco(table).encode())
        dataset = self._dataset(columns, names)
        write_whole(folder / "truth.nc", bytes(dataset.to_netcdf(engine="scipy")))

    def _rows(self, batch: ImageBatch, variables: dict[str, Any]) -> pd.DataFrame:
        """Return the rows of truth.csv of a batch with these variables, and note its cameras."""
        scenes, axes = batch.scenes, scene_axes(self.pipeline)
        first, last = batch.windows[:, :2], batch.windows[:, 2:]
        view = scenes.cameras.view
        cameras = [
            self.cameras.setdefault(FileCamera.of(scenes, row), f"camera-{len(self.cameras)}")
            if visible else "" for row, visible in enumerate(batch.visible.tolist())
        ]
        numbers = np.column_stack([
            (scenes.corners_px - first[:, None]).reshape(-1, 8),
            vector_of_rotation(scenes.rotation), scenes.translation, scenes.size_m,
        ])
        table = pd.DataFrame({
            "image": [f"{name}.png" for name in batch.names],
            "id": scenes.marker_id, "dictionary": scenes.dictionary,
            **dict(zip((*CORNERS, *POSE, "size_m"), numbers.T, strict=True)),
            **dict(zip(("width_px", "height_px"), (last - first).T, strict=True)),
            **dict(zip(("origin_x_px", "origin_y_px"), first.T, strict=True)),
            **dict(zip(("fx_px", "fy_px"), view[:, :2].T, strict=True)),
            **dict(zip(("cx_px", "cy_px"), (view[:, 2:] - first).T, strict=True)),
            "camera": cameras, "marker_area_px": variables["marker_area_px"],
        })
        lengths = tuple(len(axis) for axis in axes)
        indices = np.unravel_index(batch.numbers, lengths) if lengths else ()
        for axis, along in zip(axes, indices, strict=True):
            for name, values in axis.columns.items():
                if name not in (*table, "marker_id"):
                    labels = [label(v) if isinstance(v, tuple) else v for v in values]
                    table[name] = [labels[k] for k in along.tolist()]
        for each in drawn_variables(self.pipeline):
            if each.name not in table:
                table[each.name] = variables[each.name]
        return table.loc[batch.visible]

    def _dataset(self, columns: dict[str, list[Any]], names: list[str]) -> xr.Dataset:
        """Return the truth over the experiment's scene axes."""
        axes = scene_axes(self.pipeline)
        dims, shape = tuple(axis.name for axis in axes), tuple(len(axis) for axis in axes)

        def shaped(values: Any) -> Any:
            return np.asarray(values).reshape(shape + np.shape(values)[1:])

        variables: dict[str, Any] = {}
        for name in GEOMETRY:
            variable = VARIABLES[name]
            variables[name] = (
                dims + variable.inner, shaped(np.concatenate(columns[name])), variable.attributes()
            )
        variables["true_corners_px"] = (
            (*dims, "corner", "xy"), shaped(np.concatenate(columns["true_corners_px"])),
            {"long_name": "true corners in the frame; pixel (0, 0) is the centre of the top left "
             "pixel", "units": "px"},
        )
        variables["image"] = (
            dims, shaped(np.array(names, dtype=object)),
            {"long_name": "name of the image; empty where the marker is not visible"},
        )
        drawn = {
            each.name: (
                dims, shaped(np.concatenate(columns[each.name])),
                each.attributes(),
            )
            for each in drawn_variables(self.pipeline)
        }
        coordinates: dict[str, Any] = {
            name: list(LABELS[name]) for name in ("corner", "xy", "xyz")
        }
        for axis in axes:
            unit = {"units": axis.unit} if axis.unit else {}
            coordinates[axis.name] = (
                axis.name, _plain(axis.coordinates()), {"long_name": axis.meaning, **unit}
            )
            coordinates |= {
                name: (axis.name, _plain(np.array([label(v) if isinstance(v, tuple) else v
                                                   for v in values])))
                for name, values in axis.zipped
            }
        return xr.Dataset(
            variables, coordinates | drawn,
            {"title": self.pipeline.heading, "pipeline": self.pipeline.text},
        )


def _plain(values: Any) -> Any:
    """Return coordinates in types that netCDF has."""
    if values.dtype.kind in "TU":
        return values.astype(object)
    return values.astype(np.int8) if values.dtype.kind == "b" else values


COCO_INFO = {
    "description": "true corners of markers, as COCO keypoints",
    "pixel_center": 0,
    "corner_order": "top left, top right, bottom right, bottom left of the upright marker",
}
"""What the COCO-like file says of itself."""


def _coco(table: pd.DataFrame) -> str:
    """Return rows of truth.csv as COCO keypoints; a category is a dictionary's marker."""
    records = table.to_dict("records")
    markers = [(row["dictionary"], row["id"]) for row in records]
    categories = {marker: number for number, marker in enumerate(dict.fromkeys(markers), 1)}
    content = {
        "info": COCO_INFO,
        "images": [
            {"id": number, "file_name": f"images/{row['image']}", "width": row["width_px"],
             "height": row["height_px"]}
            for number, row in enumerate(records)
        ],
        "annotations": [
            _coco_annotation(row, number, categories[marker])
            for number, (row, marker) in enumerate(zip(records, markers, strict=True))
        ],
        "categories": [
            {"id": number, "name": f"{dictionary} {marker}", "supercategory": dictionary,
             "marker_id": marker, "keypoints": list(LABELS["corner"])}
            for (dictionary, marker), number in categories.items()
        ],
    }
    return json.dumps(content)


def _coco_annotation(row: dict[Any, Any], number: int, category: int) -> dict[str, Any]:
    points = np.array([row[name] for name in CORNERS]).reshape(4, 2)
    size = np.array([row["width_px"], row["height_px"]])
    least, extent = points.min(axis=0), np.ptp(points, axis=0)
    seen = ((points >= -0.5) & (points <= size - 0.5)).all(axis=1)  # COCO's 2: visible
    flat = points.ravel().tolist()
    return {
        "id": number, "image_id": number, "category_id": category, "iscrowd": 0,
        "bbox": [*least.tolist(), *extent.tolist()],
        "area": row["marker_area_px"], "segmentation": [flat],
        "keypoints": np.column_stack([points, 2 * seen]).ravel().tolist(),
        "num_keypoints": int(seen.sum()),
        "rvec": [row[name] for name in POSE[:3]], "tvec_m": [row[name] for name in POSE[3:]],
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
