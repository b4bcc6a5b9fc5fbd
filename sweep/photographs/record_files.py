"""The record of photographs beside their store, and the pipeline that names it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sweep.errors import StoreError
from sweep.exchange.files import write_errors, write_whole
from sweep.messages import plain
from sweep.model.photograph import Part
from sweep.photographs.folder import Folder
from sweep.photographs.pose_fit import Lens
from sweep.photographs.poses import Poses
from sweep.plan.experiment import Pipeline
from sweep.plan.photographs import SUFFIX, PhotographRecord
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Prepared:
    """Photographs that are ready to be measured.

    Attributes
    ----------
    pipeline
        The experiment.
    lines
        What was found, left out and converted, a line each.
    photographs, markers
        How many there are: markers whose pose is known.
    """

    pipeline: Pipeline
    lines: tuple[str, ...]
    photographs: int
    markers: int


def record_home(store: str | os.PathLike[str] | None) -> tuple[str, str]:
    """Return the folder and the name of the record of a store: beside it, if that is a path.

    >>> record_home("results/desk.zarr"), record_home("s3://bucket/desk.zarr"), record_home(None)
    (('results', 'desk'), ('runs', 'desk'), ('runs', ''))
    """
    if store is None:
        return "runs", ""
    url = os.fspath(store).rstrip("/")
    folder, _, last = url.rpartition("/")
    return ("runs" if "://" in url else folder or "."), last.removesuffix(".zarr")


@dataclass(frozen=True, slots=True)
class WantedMarkers:
    """The markers that are looked for: dictionary, IDs (M,) and sides (M,) in m.

    ``board`` is the document of the board's file as JSON; empty without one.
    """

    dictionary: str
    ids: tuple[int, ...]
    sizes_m: Floats
    board: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """A camera: its lens, what is known of its numbers' errors, and a line on it.

    ``sd`` are their standard deviations, ``covariance`` (c, c) is None if it is not known.
    """

    lens: Lens
    sd: tuple[float, ...] = ()
    line: str = ""
    covariance: Floats | None = None


def setting_name(setting: str) -> str:
    """Return the parameter that a setting "section.key=value" or "key=value" is of."""
    return setting.partition("=")[0].strip().rpartition(".")[2]


def name_of(folder: Path) -> str:
    """Return what a folder's store is named after."""
    return re.sub(r"[^A-Za-z0-9._+-]", "-", folder.resolve().name).strip("-._") or "photographs"


def write_record(
    found: Sequence[Folder], parts: Sequence[Part], cameras: Sequence[KnownCamera],
    markers: WantedMarkers, truth: Sequence[Poses], settings: Sequence[str], home: Path,
    name: str, lines: Sequence[str], *, overwrite: bool,
) -> Prepared:
    """Write the records, and return the experiment."""
    names = [f"{name}{SUFFIX}"] if len(found) == 1 else [
        f"{name}-{side}{SUFFIX}" for side in ("left", "right")
    ]
    contents = [
        _content(folder, part, markers, poses, home).content()
        for folder, part, poses in zip(found, parts, truth, strict=True)
    ]
    with write_errors(home):
        home.mkdir(parents=True, exist_ok=True)
        for record, content in zip(names, contents, strict=True):
            path = home / record
            used = (home / f"{name}.zarr").exists() and path.exists()
            if used and path.read_bytes() != content and not overwrite:
                raise StoreError(
                    f"{plain(path, 300)}: holds other photographs or poses, which a store may "
                    "refer to; choose another store, or overwrite it"
                )
            write_whole(path, content)
    photographs = len(found[0].photographs)
    document = _document(found, cameras, markers, names, photographs)
    pipeline = Pipeline.from_dict(
        document, [each for each in settings if setting_name(each) not in ("dictionary", "size_m")],
        name=name, source="photographs", folder=home,
    )
    known = sum(int(each.known.sum()) for each in truth)
    return Prepared(pipeline, tuple(lines), photographs, known)


def _content(
    folder: Folder, part: Part, markers: WantedMarkers, poses: Poses, home: Path
) -> PhotographRecord:
    width, height = folder.size
    start = home.resolve()
    return PhotographRecord(
        tuple(os.path.relpath(each.path.resolve(), start) for each in folder.photographs),
        tuple(each.digest for each in folder.photographs), part, width, height,
        np.array(markers.ids, dtype=np.int64), poses.rotation, poses.translation, poses.std,
        poses.source, markers.board,
    )


def _document(
    found: Sequence[Folder], cameras: Sequence[KnownCamera], markers: WantedMarkers,
    names: Sequence[str], photographs: int,
) -> dict[str, Any]:
    """Return the pipeline's document."""
    width, height = found[0].size
    numbers = [_numbers(each) for each in cameras]
    document: dict[str, Any] = {
        "title": f"Photographs of {plain(found[0].photographs[0].path.parent.name, 150)}",
        "camera": {"width_px": width, "height_px": height},
        "marker": {"dictionary": markers.dictionary},
        "scene": {},
        "axes": {"trial": photographs},
    }
    if len(names) == 1:
        document["camera"] |= numbers[0]
        if cameras[0].sd:
            document["camera"]["calibration_sd"] = list(cameras[0].sd)
        document["scene"]["photographs"] = names[0]
    else:
        columns = {key: [each[key] for each in numbers] for key in numbers[0]}
        document["axes"]["stereo_camera"] = {"zip": {"photographs": list(names), **columns}}
    if len(set(markers.sizes_m.tolist())) == 1:
        document["marker"]["size_m"] = float(markers.sizes_m[0])
        document["axes"]["marker_id"] = list(markers.ids)
    else:
        document["axes"]["marker"] = {
            "zip": {"marker_id": list(markers.ids), "size_m": markers.sizes_m.tolist()}
        }
    return document


def _numbers(camera: KnownCamera) -> dict[str, Any]:
    """Return a camera's parameters."""
    matrix = camera.lens.matrix
    return {
        "fx_px": float(matrix[0, 0]), "fy_px": float(matrix[1, 1]), "cx_px": float(matrix[0, 2]),
        "cy_px": float(matrix[1, 2]), "distortion": camera.lens.distortion.tolist(),
    }
