"""Observations to diagnose: rows of a program's answers and of measurements by tape."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from sweep.declaration import check_table
from sweep.errors import ArgumentError, PipelineError, path_of
from sweep.experiment.document import file_text
from sweep.experiment.parameters import PARAMETERS
from sweep.experiment.pipeline import parse_settings
from sweep.measure.detectors import DetectorSetting, make_detector
from sweep.measure.solver import both_planar_solutions
from sweep.messages import nearest, plain
from sweep.model.calibration import MAX_BYTES, Calibration
from sweep.model.image_file import decode_grey
from sweep.model.pose import mirrored, rotation_of_vector, vector_of_rotation
from sweep.photographs.cameras import camera_of_file, cameras_of, check_size
from sweep.photographs.folder import detect_markers
from sweep.typing import Floats, Integers

# Columns of numbers; further ones are refused, empty cells are unknown.
MEASURED = ["x_m", "y_m", "z_m", "tape_m"]
TVEC, RVEC = ["tvec_x_m", "tvec_y_m", "tvec_z_m"], ["rvec_x", "rvec_y", "rvec_z"]
CORNERS = [f"corner{k}_{axis}_px" for k in range(4) for axis in "xy"]
COLUMNS = [*TVEC, "range_m", *RVEC, *MEASURED, "tape_sd_m", "position_sd_m", "yaw_deg",
           "yaw_sd_deg", "speed_m_s", "marker_id", *CORNERS]

# Column of image files in which the corners are detected, from the CSV file's folder.
IMAGE = "image"

# Column -> columns of which a row needs one beside it: of a vector it has all or none.
NEEDED = {
    "tape_sd_m": ["tape_m"], "position_sd_m": MEASURED[:3], "yaw_sd_deg": ["yaw_deg"],
    "yaw_deg": [RVEC[0], CORNERS[0]],
    **{name: [other] for vector in (TVEC[:2], RVEC, CORNERS)
       for name, other in zip(vector, [*vector[1:], vector[0]], strict=True)}}

# Column -> numbers between which it can be, in whatever unit.
MOST_M = 1e7
RANGES = {
    **dict.fromkeys(COLUMNS, (-MOST_M, MOST_M)),
    **dict.fromkeys(("range_m", "tape_m"), (1e-5, MOST_M)),
    **dict.fromkeys(("tape_sd_m", "position_sd_m", "yaw_sd_deg"), (1e-9, MOST_M))}

# Standard deviation of a tape if none is given: the larger of 2 mm and 0.5 %.
TAPE_SD_M, TAPE_SHARE = 0.002, 0.005

# Standard deviation of the tape's zero point: where the lens' centre lies in its housing.
ZERO_SD_M = 0.01

# Standard deviations of a marker's yaw measured by eye and of one that was estimated.
YAW_SD_DEG, SOLVED_YAW_SD_DEG = 5.0, 3.0

# Refinement -> bias of the range, its spread, its noise, and the centre's noise, in pixels: the
# range is off by these pixels / side of the square. Medians of
# `pipelines/diagnose/refinements.toml` (36h11 and 4X4_50, sides 25 to 220 px, tilts to 60 degrees);
# the spread is what photographs differ from it by (light, sharpening, tone). Empty: unknown.
REFINEMENTS: dict[str, tuple[float, float, float, float]] = {
    "none": (0.80, 0.30, 0.31, 0.19),
    "subpix": (0.35, 0.30, 0.12, 0.03),
    "contour": (1.07, 0.30, 0.17, 0.04),
    "apriltag": (0.02, 0.30, 0.06, 0.03),
    "": (0.4, 0.6, 0.6, 0.3),
}

# Side of the square where neither camera nor size are known.
UNKNOWN_SIDE_PX = 80.0

# Most rows: this many take about 7 s of processor time and 1.3 GB.
MAX_ROWS = 150


# Settings of `sweep diagnose`.
BELIEFS = {each.name: each for each in (
    replace(PARAMETERS["size_m"], default=math.nan),
    replace(PARAMETERS["dictionary"], default=""),
    replace(PARAMETERS["cornerRefinementMethod"], name="refinement", default=""),
    replace(PARAMETERS["size_m"], name="zero_sd_m", default=ZERO_SD_M),
    replace(PARAMETERS["cornerRefinementMethod"], name="compared", default="z",
            choices=("z", "range")))}


def beliefs(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return all settings, of those that are given and neither None nor empty.

    Raises
    ------
    PipelineError
        A line for each setting that is not known or cannot be.
    """
    values, faults = check_table(
        BELIEFS, {name: value for name, value in given.items() if value not in (None, "")},
        "sweep diagnose")
    if faults:
        raise PipelineError(faults)
    return values


def settings_of(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of settings, as ``--set`` takes them.

    >>> settings_of(["size_m=0.153", "dictionary=DICT_4X4_50"])
    {'size_m': 0.153, 'dictionary': 'DICT_4X4_50'}
    """
    found = parse_settings(texts, BELIEFS)
    return {name: beliefs(found)[name] for name in found}


@dataclass(frozen=True)
class Observations:
    """Rows of a program's poses and of measurements.

    Attributes
    ----------
    said
        Positions (n, 3) of the marker, m, camera frame; (0, 0, range) where only a range is known.
    lateral
        Whether the program's x and y are known.
    measured, measured_sd
        Measured x, y, z and straight distance from the lens to the marker's centre (n, 4), m, NaN
        where unknown, and their standard deviations (n, 4).
    yaw_off, yaw_sd
        Measured minus said turn of the marker about the vertical, degrees, and the same of the
        other planar solution (n, 2), NaN where unknown; standard deviation of the measured (n,).
    speed
        Speed of the marker away from the camera (n,), m/s, NaN where unknown.
    camera
        As the program believes it, None if unknown.
    size_m, dictionary, refinement
        As the program believes them; NaN and empty if unknown.
    zero_sd_m
        Standard deviation of the tape's zero point.
    compared
        The number that was compared with the tape: "z" or "range".
    notes
        Lines on assumptions.
    """

    said: Floats
    lateral: bool
    measured: Floats
    measured_sd: Floats
    yaw_off: Floats
    yaw_sd: Floats
    speed: Floats
    camera: Calibration | None
    size_m: float
    dictionary: str
    refinement: str
    zero_sd_m: float
    compared: str
    notes: tuple[str, ...] = ()

    @property
    def cells(self) -> tuple[Integers, ...]:
        """Row and component (0 to 3: x, y, z, straight) of each measured number (d,)."""
        return np.nonzero(np.isfinite(self.measured))

    @property
    def known_square(self) -> bool:
        """Whether the square's side in the image follows from the program's beliefs."""
        return self.camera is not None and math.isfinite(self.size_m)

    @property
    def side_px(self) -> Floats:
        """Side of the square in the image (n,), as the program's own numbers have it."""
        if self.camera is None or not self.known_square:
            return np.full(len(self.said), UNKNOWN_SIDE_PX)
        # In other axes z is no depth: no lens of a pinhole camera sees beyond 60 degrees.
        depth = np.maximum(self.said[:, 2], np.linalg.norm(self.said, axis=1) / 2.0)
        return np.asarray(self.camera.fx_px * self.size_m / depth)


def read_observations(
    source: str | os.PathLike[str] | Mapping[str, Sequence[Any]], *,
    camera: str | os.PathLike[str] | Calibration | None = None, **given: Any,
) -> Observations:
    """Return checked observations, of a CSV file or of columns (n,), with `beliefs`.

    Raises
    ------
    ArgumentError
        One line on the first thing that cannot be: a column, a number, a unit.
    PipelineError
        A line for each setting that is not known or cannot be.
    """
    folder = Path() if isinstance(source, Mapping) else Path(path_of("observations", source)).parent
    cells = _cells(source)
    table, settings, notes = _numbers(cells), beliefs(given), list[str]()
    believed = camera if camera is None or isinstance(camera, Calibration) else camera_of_file(
        path_of("camera", camera))
    if IMAGE in cells:
        images = [folder / str(name) for name in cells[IMAGE]]
        table[CORNERS] = _detected(table, images, believed, settings)
    there = table.notna()
    for name, others in NEEDED.items():
        _each_row(~there[name] | there[others].any(axis=1),
                  f"{name} needs {' or '.join(others)} beside it")
    said, rvec = table[TVEC].to_numpy(), table[RVEC].to_numpy()
    if there[CORNERS].all(axis=None) and not there[TVEC].all(axis=None):
        if believed is None or math.isnan(settings["size_m"]):
            raise _fault("corners need --camera and --set size_m=...")
        said, rvec = _solved(table[CORNERS].to_numpy(), believed, settings["size_m"])
        notes.append("the poses were solved from the corners with this camera and size")
    lateral = bool(np.isfinite(said[:, :2]).all())
    if not lateral:
        # A row with all three numbers keeps its range.
        distance = pd.Series(np.linalg.norm(said, axis=1)).fillna(table["range_m"])
        said = np.outer(distance.fillna(table["tvec_z_m"]), [0.0, 0.0, 1.0])
    # In other axes z may be anything, which the measured position shows.
    shown = lateral & there[MEASURED[:3]].any(axis=1)
    _each_row(np.where(shown, np.linalg.norm(said, axis=1), said[:, 2]) >= 1e-5,
              "expected tvec_z_m or range_m above 0, the position that the program said; of other "
              "axes expected x_m, y_m and z_m, too")
    _each_row(there[[*MEASURED, "yaw_deg"]].any(axis=1),
              "expected tape_m, or one of x_m, y_m, z_m: what was measured by tape")
    _each_row(lateral | ~there[MEASURED[:2]].any(axis=1), "x_m and y_m need tvec_x_m and tvec_y_m")
    measured = table[MEASURED].to_numpy()
    deviations = table[["position_sd_m"] * 3 + ["tape_sd_m"]].to_numpy()
    if not np.isfinite(deviations).any():
        notes.append("no uncertainty of the tape is given: 2 mm or 0.5 % are assumed")
    lengths = np.nan_to_num(measured)
    lengths[:, :3] = np.linalg.norm(lengths[:, :3], axis=1)[:, None]
    rotation = rotation_of_vector(rvec)
    # The turn of both solutions' normals about the vertical, in degrees.
    turns = [np.degrees(np.arctan2(each[:, 0, 2], -each[:, 2, 2]))
             for each in (rotation, mirrored(rotation, said))]
    rows = Observations(
        said, lateral, measured,
        np.where(np.isfinite(deviations), deviations, tape_sd(lengths)),
        table[["yaw_deg"]].to_numpy() - np.stack(turns, axis=-1),
        table["yaw_sd_deg"].fillna(YAW_SD_DEG).to_numpy(), table["speed_m_s"].to_numpy(),
        believed, **settings)
    if not rows.known_square:
        notes.append("camera or size_m unknown: the expected bias and noise are a guess for a "
                     f"square of {UNKNOWN_SIDE_PX:g} px")
    return replace(rows, notes=tuple(notes))


def tape_sd(length: Floats) -> Floats:
    """Return the standard deviations of tapes of which none is given, m."""
    return np.maximum(TAPE_SD_M, TAPE_SHARE * length)


def _fault(text: str) -> ArgumentError:
    return ArgumentError("observations", "", text)


def _each_row(right: ArrayLike, expected: str) -> None:
    """Raise ArgumentError for the first row of a mask (n,) that is not right."""
    if not np.all(right):
        raise _fault(f"row {int(np.argmin(right)) + 1}: {expected}")


def _cells(source: str | os.PathLike[str] | Mapping[str, Sequence[Any]]) -> pd.DataFrame:
    """Return the cells of columns, or of a CSV file's, as text."""
    try:
        if isinstance(source, Mapping):
            return pd.DataFrame(dict(source))
        text = file_text(source, MAX_BYTES)
    except ValueError as error:
        given = "" if isinstance(source, Mapping) else plain(source)
        raise ArgumentError("observations", given, plain(error)) from None
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines)] or [[]]
    _each_row([len(row) == len(header) for row in rows],
              f"expected {len(header)} cells, commas between them, and points in numbers")
    if repeated := [name for name in header if header.count(name) > 1]:
        raise _fault(f"column {plain(repeated[0])} is there twice")
    return pd.DataFrame(rows, columns=header)


def _numbers(cells: pd.DataFrame) -> pd.DataFrame:
    """Return all columns of numbers; empty cells are NaN, other words are refused."""
    for name in cells:
        if name not in {*COLUMNS, IMAGE}:
            raise _fault(f"column {plain(name)} is not known{nearest(str(name), COLUMNS)}; "
                         f"expected {', '.join(COLUMNS[:-7])} ..., or {IMAGE}, with commas between "
                         "them")
    if not 0 < len(cells) <= MAX_ROWS:
        raise _fault(f"{len(cells) or 'no'} rows: expected 1 to {MAX_ROWS} below the header; "
                     "average those of one pose")
    table = cells.reindex(columns=COLUMNS).replace("", None)
    numbers = table.apply(pd.to_numeric, errors="coerce").astype(np.float64)
    for name in cells.columns.intersection(COLUMNS):
        low, high = RANGES[name]
        wrong = table[name].notna() & ~numbers[name].between(low, high)
        if wrong.any():
            row = int(wrong.argmax())
            raise _fault(f"row {row + 1}, {name} = {plain(cells[name][row])}: expected a number "
                         f"between {low:g} and {high:g}; leave the cell empty if it is unknown")
    return numbers


def _detected(
    table: pd.DataFrame, images: Sequence[Path], camera: Calibration | None, given: dict[str, Any]
) -> Floats:
    """Return the corners (n, 8) of a marker in each image (n,), which has the camera's size."""
    dictionary = given["dictionary"]
    if not dictionary:
        raise _fault(f"{IMAGE} needs --set dictionary=...")
    if table[CORNERS].notna().any(axis=None):
        raise _fault(f"{IMAGE} or corners: give one of them")
    find = make_detector(DetectorSetting(cornerRefinementMethod=given["refinement"] or "none"))
    corners = []
    for row, (image, wanted) in enumerate(zip(images, table["marker_id"], strict=True)):
        try:
            grey = decode_grey(str(image))
            if camera is not None:
                check_size("camera", "", camera, (grey.shape[1], grey.shape[0]))
            ids, quads, _ = detect_markers(find, grey, dictionary)
        except (OSError, ValueError) as error:
            raise ArgumentError("observations", plain(image), str(error)) from None
        chosen = quads if np.isnan(wanted) else quads[ids == wanted]
        if len(chosen) != 1:
            raise _fault(f"row {row + 1}: {plain(image)} shows {len(ids)} markers of {dictionary}"
                         f" (IDs {', '.join(map(str, ids.tolist())) or 'none'}): expected one, or "
                         "marker_id of one of them")
        corners.append(chosen.reshape(8))
    return np.array(corners, dtype=np.float64)


def _solved(corners: Floats, camera: Calibration, size_m: float) -> tuple[Floats, Floats]:
    """Return positions and rotation vectors (n, 3) of corners (n, 8), by guarded IPPE."""
    quads = corners.reshape(-1, 4, 2)
    frame = np.array([camera.width_px or 0, camera.height_px or 0])
    _each_row(not frame.all() or ((quads >= -0.5) & (quads <= frame)).all(axis=(1, 2)), "corners "
              f"beyond {frame[0]} x {frame[1]} px: give the calibration of their images' size")
    cameras = cameras_of(camera, len(quads))
    rotation, position = both_planar_solutions(quads, cameras, np.full(len(quads), size_m))
    _each_row(np.isfinite(position[:, 0]).all(axis=-1), "the corners have no pose; expected top "
              "left, top right, bottom right, bottom left")
    return position[:, 0], vector_of_rotation(rotation[:, 0])
