"""Observations to diagnose: rows of what a program said and of what was measured by tape."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.errors import ArgumentError
from sweep.measure.detectors import DetectorSetting, make_detector
from sweep.measure.solver import both_planar_solutions
from sweep.messages import nearest, plain
from sweep.model.calibration import MAX_BYTES, Calibration
from sweep.model.image_file import decode_grey, read_regular
from sweep.model.marker import dictionary_names
from sweep.model.pose import mirrored, rotation_of_vector, vector_of_rotation
from sweep.photographs.folder import detect_markers
from sweep.photographs.truth import camera_of_file, cameras_of, lens_of
from sweep.typing import Floats

SAID = ("tvec_x_m", "tvec_y_m", "tvec_z_m", "range_m", "rvec_x", "rvec_y", "rvec_z")
TAPE = ("tape_m", "tape_sd_m", "x_m", "y_m", "z_m", "position_sd_m", "yaw_deg", "yaw_sd_deg",
        "speed_m_s")
CORNERS = tuple(f"corner{k}_{axis}_px" for k in range(4) for axis in "xy")
COLUMNS = {*SAID, *TAPE, *CORNERS, "marker_id"}
"""Columns of numbers; further ones are refused, empty cells are unknown."""

IMAGE = "image"
"""Column of image files in which the corners are detected, from the CSV file's folder."""

WHOLE = (SAID[:2], SAID[4:], CORNERS)
"""Columns of which a row has all or none."""

NEEDED = {"tape_sd_m": ("tape_m",), "position_sd_m": ("x_m", "y_m", "z_m"),
          "yaw_sd_deg": ("yaw_deg",), "yaw_deg": ("rvec_x", CORNERS[0])}
"""Column -> columns of which a row needs one beside it."""

POSITIVE = ("tape_m", "tape_sd_m", "position_sd_m", "yaw_sd_deg")
"""Columns whose numbers are above 0."""

TAPE_SD_M, TAPE_SHARE = 0.002, 0.005
"""Standard deviation of a tape if none is given: the larger of 2 mm and 0.5 %."""

ZERO_SD_M = 0.01
"""Standard deviation of the tape's zero point: where the lens' centre lies in its housing."""

YAW_SD_DEG = 5.0
"""Standard deviation of a marker's yaw measured by eye and of one that was estimated."""

REFINEMENTS: dict[str, tuple[float, float, float, float]] = {
    "none": (0.80, 0.30, 0.31, 0.19),
    "subpix": (0.35, 0.30, 0.12, 0.03),
    "contour": (1.07, 0.30, 0.17, 0.04),
    "apriltag": (0.02, 0.30, 0.06, 0.03),
}
"""Refinement -> bias of the range, its spread, its noise, and the centre's noise, in pixels: the
range is off by these pixels / side of the square. Medians of `pipelines/diagnose/refinements.toml`
(36h11 and 4X4_50, sides 25 to 220 px, tilts to 60 degrees); the spread is what photographs differ
from it by (light, sharpening, tone)."""

UNKNOWN_REFINEMENT = (0.4, 0.6, 0.6, 0.3)
UNKNOWN_SIDE_PX = 80.0
"""Side of the square where neither camera nor size are known."""

LENGTHS_M = (1e-5, 1e7)
"""Lengths between which positions and tapes can be, in whatever unit."""

MAX_ROWS = 1000
"""Rows that are judged within half a minute."""

READABLE_PX = 4.0
"""Sides below this cannot be read: the numbers are in other units than the size."""


@dataclass(frozen=True)
class Observations:
    """Rows of poses that a program said and of what was measured.

    Attributes
    ----------
    said
        Positions (n, 3) of the marker, m, camera frame; (0, 0, range) where only a range is known.
    lateral
        Whether the program's x and y are known.
    spatial
        Whether positions were measured, and not straight distances alone.
    tape, tape_sd
        Straight distance from the lens to the marker's centre (n,), m, NaN where unknown.
    position, position_sd
        Measured positions (n, 3), m, NaN where unknown, and their standard deviation (n,).
    yaw, yaw_said, yaw_mirrored, yaw_sd
        The marker's turn about the vertical (n,), degrees: measured, said, and that of the other
        planar solution; 0 where it faces along the optical axis, NaN where unknown.
    speed
        Speed of the marker away from the camera (n,), m/s, NaN where unknown.
    camera
        As the program believes it, None if unknown.
    size_m, dictionary, refinement
        As the program believes them; NaN and empty if unknown.
    zero_sd_m
        Standard deviation of the tape's zero point.
    compared
        What was compared with the tape: "z" or "range".
    notes
        Lines on what was assumed.
    """

    said: Floats
    lateral: bool
    spatial: bool
    tape: Floats
    tape_sd: Floats
    position: Floats
    position_sd: Floats
    yaw: Floats
    yaw_said: Floats
    yaw_mirrored: Floats
    yaw_sd: Floats
    speed: Floats
    camera: Calibration | None
    size_m: float
    dictionary: str
    refinement: str
    zero_sd_m: float
    compared: str
    notes: tuple[str, ...]

    @property
    def side_px(self) -> Floats:
        """Side of the square in the image (n,), as the program's own numbers have it."""
        if self.camera is None or not math.isfinite(self.size_m):
            return np.full(len(self.said), UNKNOWN_SIDE_PX)
        return np.asarray(self.camera.fx_px * self.size_m / self.said[:, 2])

    @property
    def expected(self) -> tuple[float, float, float, float]:
        """Bias, its spread, noise and lateral noise, in pixels, of the refinement."""
        return REFINEMENTS.get(self.refinement, UNKNOWN_REFINEMENT)


def read_observations(
    source: str | os.PathLike[str] | Mapping[str, Sequence[Any]], *,
    camera: str | os.PathLike[str] | Calibration | None = None, size_m: float | None = None,
    dictionary: str = "", refinement: str = "", zero_sd_m: float = ZERO_SD_M,
    compared: str = "z",
) -> Observations:
    """Return checked observations, of a CSV file or of columns (n,).

    Raises
    ------
    ArgumentError
        One line on the first thing that cannot be: a column, a number, a unit.
    """
    columns = dict(source) if isinstance(source, Mapping) else _read_csv(os.fspath(source))
    for name in columns:
        if name not in (*COLUMNS, IMAGE):
            raise _fault(f"column {plain(name)} is not known{nearest(name, sorted(COLUMNS))}; "
                         f"expected {', '.join(SAID)} and {', '.join(TAPE)}, or {IMAGE}, or "
                         f"corners {CORNERS[0]} ...")
    count = max((len(values) for values in columns.values()), default=0)
    if not 0 < count <= MAX_ROWS:
        raise _fault(f"{count or 'no'} rows: expected 1 to {MAX_ROWS} below the header")
    for setting, value, known in (
        ("dictionary", dictionary, dictionary_names()), ("refinement", refinement, [*REFINEMENTS]),
        ("compared", compared, ["z", "range"]),
    ):
        if value and value not in known:
            expected = nearest(value, known) or f"; expected one of {', '.join(known)}"
            raise ArgumentError(setting, plain(value), f"is not known{expected}")
    for name, number in (("size_m", size_m), ("zero_sd_m", zero_sd_m)):
        if number is not None and not 0 < number < math.inf:
            raise ArgumentError(name, number, "expected metres above 0")
    believed = camera if camera is None or isinstance(camera, Calibration) else camera_of_file(
        os.fspath(camera))
    values = {name: _numbers(name, columns[name], count) if name in columns
              else np.full(count, np.nan) for name in COLUMNS}
    notes: list[str] = []
    if IMAGE in columns:
        folder = Path() if isinstance(source, Mapping) else Path(source).parent
        _detect(values, [folder / name for name in columns[IMAGE]], dictionary, refinement)
        notes.append(f"corners were detected in the images, {refinement or 'none'} refined")
    _check_complete(values)
    said, rvec = (np.stack([values[name] for name in SAID[k : k + 3]], axis=-1) for k in (0, 4))
    if np.isfinite(values[CORNERS[0]]).all() and not np.isfinite(said[:, 2]).all():
        if believed is None or size_m is None:
            raise _fault("corners need --camera and --set size_m=...")
        said, rvec = _solved(values, believed, size_m)
        notes.append("the poses were solved from the corners with this camera and size")
    lateral = bool(np.isfinite(said[:, :2]).all())
    if not lateral:
        distance = np.where(np.isfinite(said[:, 2]), said[:, 2], values["range_m"])
        said = np.stack([np.zeros(count), np.zeros(count), distance], axis=-1)
        compared = "range"
    position = np.stack([values[name] for name in ("x_m", "y_m", "z_m")], axis=-1)
    _each_row(np.isfinite(said).all(axis=1) & (said[:, 2] > 0),
              "expected tvec_z_m or range_m above 0: the position that the program said")
    _each_row(np.isfinite([values["tape_m"], *position.T, values["yaw_deg"]]).any(axis=0),
              "expected tape_m, or one of x_m, y_m, z_m: what was measured by tape")
    _each_row(lateral | ~np.isfinite(position[:, :2]).any(axis=1),
              "x_m and y_m need tvec_x_m and tvec_y_m")
    for name in POSITIVE:
        _each_row(~(values[name] <= 0), f"{name}: expected numbers above 0")
    lengths = np.nan_to_num(np.concatenate([said, position, values["tape_m"][:, None]], axis=1))
    _each_row((np.abs(lengths) < LENGTHS_M[1]).all(axis=1) & (said[:, 2] > LENGTHS_M[0]),
              f"expected metres between {LENGTHS_M[0]:g} and {LENGTHS_M[1]:g}")
    if not np.isfinite([values["tape_sd_m"], values["position_sd_m"]]).any():
        notes.append("no uncertainty of the tape is given: 2 mm or 0.5 % are assumed")

    def filled(name: str, default: Any) -> Floats:
        return np.where(np.isfinite(values[name]), values[name], default)

    tape_sd, position_sd = (
        filled(name, np.maximum(TAPE_SD_M, TAPE_SHARE * np.nan_to_num(length)))
        for name, length in (("tape_sd_m", values["tape_m"]),
                             ("position_sd_m", np.linalg.norm(np.nan_to_num(position), axis=1))))
    rotation = rotation_of_vector(rvec)
    rows = Observations(
        said, lateral, bool(np.isfinite(position).any()), values["tape_m"], tape_sd, position,
        position_sd, values["yaw_deg"], _yaw(rotation), _yaw(mirrored(rotation, said)),
        filled("yaw_sd_deg", YAW_SD_DEG), values["speed_m_s"], believed,
        math.nan if size_m is None else size_m, dictionary, refinement, zero_sd_m, compared, ())
    if believed is None or size_m is None:
        notes.append("camera or size_m unknown: the expected bias and noise are a guess for a "
                     f"square of {UNKNOWN_SIDE_PX:g} px")
    elif (small := rows.side_px < READABLE_PX).any():
        row = int(np.argmax(small))
        notes.append(
            f"row {row + 1}: {said[row, 2]:g} m for a square of {size_m:g} m is a side of "
            f"{rows.side_px[row]:.2g} px, which no detector reads: units of tvec or size_m differ")
    return dataclasses.replace(rows, notes=tuple(notes))


def _fault(text: str) -> ArgumentError:
    return ArgumentError("observations", "", text)


def _each_row(right: ArrayLike, expected: str) -> None:
    """Raise ArgumentError for the first row of a mask (n,) that is not right."""
    if not np.all(right):
        raise _fault(f"row {int(np.argmin(right)) + 1}: {expected}")


def _check_complete(values: Mapping[str, Floats]) -> None:
    """Raise ArgumentError where a row has a part of a vector, or a number without its companion."""
    for names in WHOLE:
        there = np.isfinite([values[name] for name in names])
        for name, own in zip(names, there, strict=True):
            _each_row(own | ~there.any(axis=0),
                      f"{name} is missing: give all of {names[0]} ... {names[-1]}, or none")
    for name, others in NEEDED.items():
        beside = np.isfinite([values[other] for other in others]).any(axis=0)
        _each_row(beside | ~np.isfinite(values[name]),
                  f"{name} needs {' or '.join(others)} beside it")


SETTINGS: dict[str, type] = {
    "size_m": float, "dictionary": str, "refinement": str, "zero_sd_m": float, "compared": str}
"""Settings of `sweep diagnose`, and their types."""


def settings_of(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of settings, as ``--set`` takes them.

    >>> settings_of(["size_m=0.153", "dictionary=DICT_4X4_50"])
    {'size_m': 0.153, 'dictionary': 'DICT_4X4_50'}
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, written = (part.strip().strip("'\"") for part in text.partition("="))
        if not equals or name not in SETTINGS:
            raise ArgumentError("settings", plain(text), "expected one of "
                                f"{', '.join(SETTINGS)}, such as size_m=0.153"
                                + nearest(name, list(SETTINGS)))
        try:
            found[name] = SETTINGS[name](written)
        except ValueError:
            raise ArgumentError("settings", plain(text), "expected a number") from None
    return found


def _read_csv(path: str) -> dict[str, list[str]]:
    try:
        text = read_regular(path, MAX_BYTES).decode("utf-8-sig")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ArgumentError("observations", plain(path), reason) from None
    lines = csv.reader(line for line in text.splitlines() if not line.startswith("#"))
    header, *rows = [[cell.strip() for cell in row] for row in lines if any(row)] or [[]]
    if len(header) == 1 and {*";\t"} & {*header[0]}:
        raise ArgumentError("observations", plain(path), "expected commas between columns, and "
                            "points in numbers")
    if twice := {name for name in header if header.count(name) > 1}:
        raise ArgumentError("observations", plain(path), f"column {plain(min(twice))} is there "
                            "twice")
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise ArgumentError("observations", plain(path), f"row {number} has {len(row)} cells, "
                                f"the header {len(header)}")
    return {name: [row[k] for row in rows] for k, name in enumerate(header)}


def _numbers(name: str, cells: Sequence[Any], count: int) -> Floats:
    """Return a column's numbers (count,); empty cells are NaN, written NaN is refused."""
    numbers = np.full(count, np.nan)
    if len(cells) != count:
        raise _fault(f"column {name} has {len(cells)} rows of {count}")
    for row, cell in enumerate(cells):
        if cell is None or cell == "":
            continue
        with contextlib.suppress(TypeError, ValueError):
            numbers[row] = float(cell)
        if not math.isfinite(numbers[row]):
            raise _fault(f"row {row + 1}, {name} = {plain(cell)}: expected a number; leave the "
                         "cell empty if it is unknown")
    return numbers


def _detect(
    values: dict[str, Floats], images: Sequence[Path], dictionary: str, refinement: str
) -> None:
    """Write the corners of a marker in each image (n,) into the columns of corners."""
    if not dictionary:
        raise _fault(f"{IMAGE} needs --set dictionary=...")
    if np.isfinite(values[CORNERS[0]]).any():
        raise _fault(f"{IMAGE} or corners: give one of them")
    find = make_detector(DetectorSetting(cornerRefinementMethod=refinement or "none"))
    for row, image in enumerate(images):
        try:
            ids, quads = detect_markers(find, decode_grey(str(image)), dictionary)
        except (OSError, ValueError) as error:
            raise ArgumentError("observations", plain(image), str(error)) from None
        wanted = values["marker_id"][row]
        chosen = quads if np.isnan(wanted) else quads[ids == wanted]
        if len(chosen) != 1:
            raise _fault(f"row {row + 1}: {plain(image)} shows {len(ids)} markers of {dictionary}"
                         f" (IDs {', '.join(map(str, ids.tolist())) or 'none'}): expected one, or "
                         "marker_id of one of them")
        for name, number in zip(CORNERS, chosen.ravel(), strict=True):
            values[name][row] = number


def _solved(values: Mapping[str, Floats], camera: Calibration, size_m: float) -> tuple[
        Floats, Floats]:
    """Return positions and rotation vectors (n, 3) of corners, TL, TR, BR, BL, by guarded IPPE."""
    corners = np.stack([values[name] for name in CORNERS], axis=-1).reshape(-1, 4, 2)
    frame = (camera.width_px, camera.height_px)
    if all(frame) and (corners > np.array(frame, dtype=np.float64)).any():
        raise _fault("corners lie beyond the camera file's image of "
                     f"{frame[0]} x {frame[1]} px: expected the calibration of their images")
    cameras = cameras_of(lens_of(camera), len(corners))
    rotation, position = both_planar_solutions(corners, cameras, np.full(len(corners), size_m))
    _each_row(np.isfinite(position[:, 0]).all(axis=-1), "the corners have no pose; expected top "
              "left, top right, bottom right, bottom left")
    return position[:, 0], vector_of_rotation(rotation[:, 0])


def _yaw(rotation: Floats) -> Floats:
    """Return the turn (n,) in degrees of normals of rotations (n, 3, 3) about the vertical."""
    return np.degrees(np.arctan2(rotation[:, 0, 2], -rotation[:, 2, 2]))
