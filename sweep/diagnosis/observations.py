"""Observations to diagnose: rows of what a program said and of what was measured by tape."""

from __future__ import annotations

import contextlib
import csv
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.errors import ArgumentError
from sweep.measure.solver import both_planar_solutions
from sweep.messages import nearest, plain
from sweep.model.calibration import MAX_BYTES, Calibration
from sweep.model.image_file import read_regular
from sweep.model.marker import dictionary_names
from sweep.model.pose import mirrored, rotation_of_vector, vector_of_rotation
from sweep.photographs.truth import camera_of_file, cameras_of, lens_of
from sweep.typing import Floats

SAID = ("tvec_x_m", "tvec_y_m", "tvec_z_m", "range_m", "rvec_x", "rvec_y", "rvec_z")
TAPE = ("tape_m", "tape_sd_m", "x_m", "y_m", "z_m", "position_sd_m", "yaw_deg", "yaw_sd_deg",
        "speed_m_s")
CORNERS = tuple(f"corner{k}_{axis}_px" for k in range(4) for axis in "xy")
COLUMNS = {*SAID, *TAPE, *CORNERS}
"""Columns of a file of observations; further ones are refused, empty cells are unknown."""

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
    tape, tape_sd
        Straight distance from the lens to the marker's centre (n,), m, NaN where unknown.
    spatial
        Whether positions were measured, and not straight distances alone.
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
        if name not in COLUMNS:
            raise ArgumentError("observations", "", f"column {plain(name)} is not known"
                                f"{nearest(name, sorted(COLUMNS))}; expected {', '.join(SAID)} "
                                f"and {', '.join(TAPE)}, or corners {CORNERS[0]} ...")
    count = max((len(values) for values in columns.values()), default=0)
    if not count:
        raise ArgumentError("observations", "", "no rows: expected one or more below the header")
    if dictionary and dictionary not in dictionary_names():
        raise ArgumentError("dictionary", plain(dictionary), "is not known"
                            + nearest(dictionary, dictionary_names()))
    if refinement and refinement not in REFINEMENTS:
        raise ArgumentError("refinement", plain(refinement),
                            f"expected one of {', '.join(REFINEMENTS)}")
    if compared not in ("z", "range"):
        raise ArgumentError("compared", plain(compared), "expected z or range")
    for name, value in (("size_m", size_m), ("zero_sd_m", zero_sd_m)):
        if value is not None and not 0 < value < math.inf:
            raise ArgumentError(name, value, "expected metres above 0")
    known = camera if camera is None or isinstance(camera, Calibration) else camera_of_file(
        os.fspath(camera))
    values = {name: _numbers(name, columns[name], count) if name in columns
              else np.full(count, np.nan) for name in COLUMNS}
    _check_complete(values)
    said, rvec = (np.stack([values[name] for name in SAID[k : k + 3]], axis=-1) for k in (0, 4))
    notes: list[str] = []
    if np.isfinite(values[CORNERS[0]]).all() and not np.isfinite(said[:, 2]).all():
        if known is None or size_m is None:
            raise ArgumentError("observations", "", "corners need --camera and --set size_m=...")
        said, rvec = _solved(values, known, size_m)
        notes.append("the poses were solved from the corners with this camera and size")
    lateral = bool(np.isfinite(said[:, :2]).all())
    if not lateral:
        distance = np.where(np.isfinite(said[:, 2]), said[:, 2], values["range_m"])
        said = np.stack([np.zeros(count), np.zeros(count), distance], axis=-1)
        compared = "range"
    position = np.stack([values[name] for name in ("x_m", "y_m", "z_m")], axis=-1)
    if not np.isfinite(said).all() or not (said[:, 2] > 0).all():
        row = int(np.argmin(np.isfinite(said).all(axis=1) & (said[:, 2] > 0))) + 1
        raise ArgumentError("observations", "", f"row {row}: expected tvec_z_m or range_m above 0: "
                            "the position that the program said")
    measured = np.isfinite([values["tape_m"], *position.T, values["yaw_deg"]]).any(axis=0)
    if not measured.all():
        raise ArgumentError("observations", "", f"row {int(np.argmin(measured)) + 1}: expected "
                            "tape_m, or one of x_m, y_m, z_m: what was measured by tape")
    if not lateral and np.isfinite(position[:, :2]).any():
        raise ArgumentError("observations", "", "x_m and y_m need tvec_x_m and tvec_y_m")
    for name in POSITIVE:
        if (values[name] <= 0).any():
            raise ArgumentError("observations", "", f"{name}: expected numbers above 0")
    lengths = np.nan_to_num(np.concatenate([said, position, values["tape_m"][:, None]], axis=1))
    if not ((np.abs(lengths) < LENGTHS_M[1]).all() and (said[:, 2] > LENGTHS_M[0]).all()):
        raise ArgumentError("observations", "", "positions and tapes: expected metres between "
                            f"{LENGTHS_M[0]:g} and {LENGTHS_M[1]:g}")
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
        filled("yaw_sd_deg", YAW_SD_DEG), values["speed_m_s"], known,
        math.nan if size_m is None else size_m, dictionary, refinement, zero_sd_m, compared, ())
    if known is None or size_m is None:
        notes.append("camera or size_m unknown: the expected bias and noise are a guess for a "
                     f"square of {UNKNOWN_SIDE_PX:g} px")
    elif (small := rows.side_px < READABLE_PX).any():
        row = int(np.argmax(small))
        notes.append(
            f"row {row + 1}: {said[row, 2]:g} m for a square of {size_m:g} m is a side of "
            f"{rows.side_px[row]:.2g} px, which no detector reads: units of tvec or size_m differ")
    return Observations(**{**vars(rows), "notes": tuple(notes)})


def _check_complete(values: Mapping[str, Floats]) -> None:
    """Raise ArgumentError where a row has a part of a vector, or a number without its companion."""
    for names in WHOLE:
        given = np.isfinite([values[name] for name in names])
        for row in np.flatnonzero(given.any(axis=0) & ~given.all(axis=0)):
            missing = next(name for name, there in zip(names, given[:, row], strict=True)
                           if not there)
            raise ArgumentError("observations", "", f"row {row + 1}: {missing} is missing: give "
                                f"all of {names[0]} ... {names[-1]}, or none")
    for name, others in NEEDED.items():
        alone = np.isfinite(values[name]) & ~np.isfinite([values[o] for o in others]).any(axis=0)
        if alone.any():
            raise ArgumentError("observations", "", f"row {int(np.argmax(alone)) + 1}: {name} "
                                f"needs {' or '.join(others)} beside it")


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
    rows = list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))
    rows = [[cell.strip() for cell in row] for row in rows if any(row)]
    if not rows:
        raise ArgumentError("observations", plain(path), "is empty: expected a header and rows")
    if twice := {name for name in rows[0] if rows[0].count(name) > 1}:
        raise ArgumentError("observations", plain(path), f"column {plain(min(twice))} is there "
                            "twice")
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(rows[0]):
            raise ArgumentError("observations", plain(path), f"row {number} has {len(row)} cells, "
                                f"the header {len(rows[0])}")
    return {name: [row[k] for row in rows[1:]] for k, name in enumerate(rows[0])}


def _numbers(name: str, cells: Sequence[Any], count: int) -> Floats:
    """Return a column's numbers (count,); empty cells are NaN, written NaN is refused."""
    numbers = np.full(count, np.nan)
    if len(cells) != count:
        raise ArgumentError("observations", "", f"column {name} has {len(cells)} rows of {count}")
    for row, cell in enumerate(cells):
        if cell is None or cell == "":
            continue
        with contextlib.suppress(TypeError, ValueError):
            numbers[row] = float(cell)
        if not math.isfinite(numbers[row]):
            raise ArgumentError("observations", "", f"row {row + 1}, {name} = {plain(cell)}: "
                                "expected a number; leave the cell empty if it is unknown")
    return numbers


def _solved(values: Mapping[str, Floats], camera: Calibration, size_m: float) -> tuple[
        Floats, Floats]:
    """Return positions and rotation vectors (n, 3) of corners, TL, TR, BR, BL, by guarded IPPE."""
    corners = np.stack([values[name] for name in CORNERS], axis=-1).reshape(-1, 4, 2)
    frame = (camera.width_px, camera.height_px)
    if all(frame) and (corners > np.array(frame, dtype=np.float64)).any():
        raise ArgumentError("observations", "", "corners lie beyond the camera file's image of "
                            f"{frame[0]} x {frame[1]} px: expected the calibration of their images")
    cameras = cameras_of(lens_of(camera), len(corners))
    rotation, position = both_planar_solutions(corners, cameras, np.full(len(corners), size_m))
    solved = np.isfinite(position[:, 0]).all(axis=-1)
    if not solved.all():
        row = int(np.argmin(solved)) + 1
        raise ArgumentError("observations", "", f"row {row}: the corners have no "
                            "pose; expected top left, top right, bottom right, bottom left")
    return position[:, 0], vector_of_rotation(rotation[:, 0])


def _yaw(rotation: Floats) -> Floats:
    """Return the turn (n,) in degrees of normals of rotations (n, 3, 3) about the vertical."""
    return np.degrees(np.arctan2(rotation[:, 0, 2], -rotation[:, 2, 2]))
