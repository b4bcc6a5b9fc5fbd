"""The truth of exported images: a CSV row, COCO records, and the variables of a dataset."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.evaluation.variables import GEOMETRY
from sweep.exchange.camera_files import FileCamera
from sweep.exchange.files import replaced_file
from sweep.exchange.image_set import ImageBatch, image_batches
from sweep.messages import label
from sweep.model.pose import vector_of_rotation
from sweep.plan.coordinates import drawn_quantities
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes
from sweep.plan.schema import VARIABLES
from sweep.plan.variable import LABELS

if TYPE_CHECKING:
    import xarray as xr

CORNERS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
"""Columns of the corners: x0, y0 of the top left one, then clockwise on the marker."""

COLUMNS = (
    "image", "id", "dictionary", *CORNERS, "rx", "ry", "rz", "tx", "ty", "tz", "size_m",
    "width_px", "height_px", "origin_x_px", "origin_y_px", "fx_px", "fy_px", "cx_px", "cy_px",
    "camera", "marker_area_px",
)
"""Columns of truth.csv, before those of the experiment's axes and draws."""


@dataclass(slots=True)
class TruthTables:
    """Tables of the truth that grow by batches of scenes.

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
        drawn = drawn_quantities(self.pipeline)
        columns |= {each.name: [] for each in drawn}
        names: list[str] = []
        extra = self._extra_columns()
        categories: dict[tuple[str, int], int] = {}
        with (
            replaced_file(folder / "truth.csv") as table,
            replaced_file(folder / "truth_coco.json") as coco,
            tempfile.TemporaryFile("w+", encoding="utf-8", dir=folder) as annotations,
        ):
            rows = csv.writer(table, lineterminator="\n")
            rows.writerow([*COLUMNS, *extra])
            coco.write(f'{{"info": {json.dumps(COCO_INFO)},\n"images": [')
            for batch in image_batches(self.pipeline, windowed=self.windowed):
                for name, function in GEOMETRY.items():
                    columns[name].append(function(batch.scenes))
                columns["true_corners_px"].append(batch.scenes.corners_px)
                for each in drawn:
                    columns[each.name].append(each.of(batch.values, len(batch)))
                names += [
                    f"{name}.png" if visible else ""
                    for name, visible in zip(batch.names, batch.visible.tolist(), strict=True)
                ]
                for record in self._records(batch, columns, extra):
                    rows.writerow(record)
                    number = self.images
                    key = str(record[2]), int(record[1])
                    category = categories.setdefault(key, len(categories) + 1)
                    separator = ",\n" if number else "\n"
                    coco.write(separator + json.dumps(_coco_image(record, number)))
                    annotations.write(
                        separator + json.dumps(_coco_annotation(record, number, category))
                    )
                    self.images += 1
                self.invisible += int((~batch.visible).sum())
            coco.write('\n],\n"annotations": [')
            annotations.seek(0)
            shutil.copyfileobj(annotations, coco)
            listed = [
                {"id": number, "name": f"{dictionary} {marker}", "supercategory": dictionary,
                 "marker_id": marker, "keypoints": list(LABELS["corner"])}
                for (dictionary, marker), number in categories.items()
            ]
            coco.write(f'\n],\n"categories": {json.dumps(listed)}}}\n')
        dataset = self._dataset(columns, names)
        temporary = folder / "truth.nc.part"
        dataset.to_netcdf(temporary, engine="scipy")
        temporary.replace(folder / "truth.nc")

    def _extra_columns(self) -> list[str]:
        """Return the columns of what varies: axes, and draws."""
        varying = [name for axis in scene_axes(self.pipeline) for name in axis.columns]
        varying += [each.name for each in drawn_quantities(self.pipeline)]
        return [name for name in dict.fromkeys(varying) if name not in (*COLUMNS, "marker_id")]

    def _records(
        self, batch: ImageBatch, columns: dict[str, list[Any]], extra: list[str]
    ) -> Iterator[list[Any]]:
        """Yield the rows of truth.csv of a batch whose variables are the last of ``columns``."""
        scenes, axes = batch.scenes, scene_axes(self.pipeline)
        vectors = vector_of_rotation(scenes.rotation)
        origins = batch.windows[:, :2]
        corners = scenes.corners_px - origins[:, None]
        lengths = tuple(len(axis) for axis in axes)
        names = batch.names
        for row in np.flatnonzero(batch.visible).tolist():
            index = np.unravel_index(batch.numbers[row], lengths) if lengths else ()
            varying = {
                name: label(value) if isinstance(value, tuple) else value
                for axis, k in zip(axes, index, strict=True)
                for name, value in axis.at(int(k)).items()
            }
            varying |= {
                each.name: float(columns[each.name][-1][row])
                for each in drawn_quantities(self.pipeline)
            }
            camera = FileCamera.of(scenes, row)
            x0, y0, x1, y1 = batch.windows[row].tolist()
            fx, fy, cx, cy = scenes.cameras.view[row].tolist()
            yield [
                f"{names[row]}.png", scenes.marker_id[row], scenes.dictionary[row],
                *corners[row].ravel().tolist(), *vectors[row].tolist(),
                *scenes.translation[row].tolist(), float(scenes.size_m[row]), x1 - x0, y1 - y0,
                x0, y0, fx, fy, cx - x0, cy - y0,
                self.cameras.setdefault(camera, f"camera-{len(self.cameras)}"),
                float(columns["marker_area_px"][-1][row]), *(varying[name] for name in extra),
            ]

    def _dataset(self, columns: dict[str, list[Any]], names: list[str]) -> xr.Dataset:
        """Return the truth over the experiment's scene axes."""
        import xarray as xr  # noqa: PLC0415  (slow to import)

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
                {"long_name": each.meaning, **({"units": each.unit} if each.unit else {})},
            )
            for each in drawn_quantities(self.pipeline)
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


def _coco_image(record: list[Any], number: int) -> dict[str, Any]:
    named = dict(zip(COLUMNS, record, strict=False))
    return {
        "id": number, "file_name": f"images/{named['image']}", "width": named["width_px"],
        "height": named["height_px"],
    }


def _coco_annotation(record: list[Any], number: int, category: int) -> dict[str, Any]:
    named = dict(zip(COLUMNS, record, strict=False))
    points = [(named[f"x{k}"], named[f"y{k}"]) for k in range(4)]
    flat = list(itertools.chain(*points))
    xs, ys = flat[::2], flat[1::2]
    seen = [
        2 if -0.5 <= x <= named["width_px"] - 0.5 and -0.5 <= y <= named["height_px"] - 0.5 else 0
        for x, y in points
    ]
    return {
        "id": number, "image_id": number, "category_id": category, "iscrowd": 0,
        "bbox": [min(xs), min(ys), max(xs) - min(xs), max(ys) - min(ys)],
        "area": named["marker_area_px"], "segmentation": [flat],
        "keypoints": list(itertools.chain(*(
            (*point, flag) for point, flag in zip(points, seen, strict=True)
        ))),
        "num_keypoints": sum(flag > 0 for flag in seen),
        "rvec": [named["rx"], named["ry"], named["rz"]],
        "tvec_m": [named["tx"], named["ty"], named["tz"]],
    }
