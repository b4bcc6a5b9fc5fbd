"""Photographs: files of their boards, and the record of their files and of each marker's pose.

A pipeline names it by the parameter ``photographs``. Its scenes are then photographs, one a trial,
and the poses are the record's; with ``simulated`` the images are not the photographs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.declaration import Declared, check_table, declared_fields
from sweep.errors import PipelineError, PluginError
from sweep.experiment.document import file_text, read_document, refusing
from sweep.measure.flags import DetectionStatus, TruthSource
from sweep.measure.surroundings import BoardMarker, clear_modules, with_neighbours
from sweep.messages import plain, shown
from sweep.model.board import Board
from sweep.model.board_kinds import KINDS
from sweep.model.camera import Column
from sweep.model.image_file import Part, reference
from sweep.model.pose import angles_of_rotation
from sweep.model.renderers import PHOTOGRAPH
from sweep.plugins.loading import ArrayFile
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Files that describe a board, `BOARD.toml`: all faults of one are found at once.

def read_board(path: str | Path) -> Board:
    """Return the board that a TOML file describes.

    Raises
    ------
    PipelineError
        One line for each fault: the file, the key, its value, and what was expected.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "board.toml"
    ...     _ = path.write_text('''kind = "grid"
    ... dictionary = "DICT_4X4_50"
    ... rows = 2
    ... columns = 3
    ... marker_m = 0.04
    ... gap_m = 0.01''')
    ...     read_board(path).marker_ids
    (0, 1, 2, 3, 4, 5)
    """
    return board_of(board_document(path), plain(path))


def board_document(path: str | Path) -> dict[str, Any]:
    """Return the tables and values of a board's file, unchecked; as :func:`read_board`."""
    with refusing(plain(path)):
        return read_document(file_text(path))


_KIND = {"kind": Declared(
    "kind", (str,), MISSING, "how its markers are arranged", choices=tuple(KINDS))}


def board_of(document: Mapping[str, Any], source: str) -> Board:
    """Return the board of a document; as :func:`read_board`, lines beginning with ``source``."""
    others = {key: value for key, value in document.items() if key != "kind"}
    known, faults = check_table(
        _KIND, {key: document[key] for key in document.keys() - others}, "a board")
    if not faults:
        kind = known["kind"]
        values, faults = check_table(
            declared_fields(KINDS[kind]), others, f"a board of kind {kind}")
    if not faults:
        made = KINDS[kind](**values)
        faults = [f"{key} = {shown(value)}: expected {expected}"
                  for key, value, expected in made.faults()]
    if not faults and not made.board().is_flat:
        faults = ["markers: expected one plane, for photographs: no z_m, no tilt_deg"]
    if faults:
        raise PipelineError([f"{source}: {fault}" for fault in faults])
    return made.board()


# --------------------------------------------------------------------------------------------------
# The record: a file of arrays, which is read once in each process.

#: End of the name of a record's file.
SUFFIX = ".photographs.npz"


@dataclass(frozen=True, slots=True, eq=False)
class PhotographRecord(ArrayFile):
    """P photographs of M markers, and their poses in the camera's frame.

    Attributes
    ----------
    paths, digests
        (P,) the photographs' files, relative to the record's folder, and their SHA-256.
    part
        The part of each image that is the photograph.
    width_px, height_px
        Of that part.
    marker_id
        (M,) IDs, increasing.
    rotation, translation
        (P, M, 3, 3) and (P, M, 3) in metres, marker to camera; NaN where a marker is not wholly
        in the photograph.
    std
        (P, M, 6) standard deviations of the poses: rotation vector in rad, position in m, camera
        frame; NaN where they are not known.
    source
        (P, M) :class:`~sweep.measure.flags.TruthSource`; without a pose ``none`` says that no
        marker of the board is seen in the photograph.
    board
        The document of the board's file as JSON; empty if the markers are single ones.
    """

    meaning = "a record of photographs that `sweep photos` writes"
    version = 3
    shapes = {  # noqa: RUF012
        "paths": ("P",), "digests": ("P",), "marker_id": ("M",), "rotation": ("P", "M", 3, 3),
        "translation": ("P", "M", 3), "std": ("P", "M", 6), "source": ("P", "M")}
    paths: tuple[str, ...]
    digests: tuple[str, ...]
    part: Part
    width_px: int
    height_px: int
    marker_id: Integers
    rotation: Floats
    translation: Floats
    std: Floats
    source: NDArray[np.uint8]
    board: str = ""

    @property
    def shown(self) -> Masks:
        """Which marker is in which photograph, (P, M)."""
        return np.asarray(np.isfinite(self.translation).all(axis=2))

    def on_board(self, marker_id: NDArray[np.int64]) -> list[BoardMarker | None]:
        """Return the marker of the board that each of some markers is; None without a board."""
        if not self.board:
            return [None] * len(marker_id)
        board = _board(self.board)
        numbers = {each: number for number, each in enumerate(board.marker_ids)}
        return [BoardMarker(board, numbers[each]) for each in marker_id.tolist()]

    @property
    def size(self) -> Integers:
        """Width and height in px, (2,)."""
        return np.array([self.width_px, self.height_px])


#: Modules beyond what a board leaves clear around a marker that a simulation of it shows: nothing
#: farther out influences the marker's corners.
BESIDE_MODULES = 4.0


@lru_cache(maxsize=8)
def _board(document: str) -> Board:
    """Return the board of a record, the same object for the same document."""
    return board_of(json.loads(document), "board")


def recorded_poses(
    values: Mapping[str, Column], trials: NDArray[np.int64], folder: str, *, simulated: bool = False
) -> dict[str, Column]:
    """Return the parameters of N scenes that are photographs, by name.

    They are the image, the pose (NaN where a photograph does not show the marker), ``truth`` (N,)
    and ``truth_std`` (N, 6) as a record's ``source`` and ``std``, ``absent`` (N,), the detection's
    flag where there is no pose, and ``on_board``: the marker of a board that each is, or None.

    Parameters
    ----------
    values
        The records' files and the markers' IDs.
    trials
        Numbers of the photographs (N,).
    folder
        Where relative paths start.
    simulated
        Whether the images are simulated, each marker by itself: in place of the image there is
        ``neighbourhood``, the marker with its board's other prints around it (None of a single
        one), and trials beyond the photographs begin again with the first.

    Raises
    ------
    PluginError
        If a record cannot be read, or has no such photograph or marker.
    """
    count = len(trials)
    names = values["photographs"].listed(count)
    records = {
        name: PhotographRecord.read(Path(folder) / name)[0] for name in dict.fromkeys(names)}
    ids = {name: record.marker_id.tolist() for name, record in records.items()}
    boards = {name: record.on_board(record.marker_id) for name, record in records.items()}
    places: list[tuple[str, int, int]] = []
    wanted = values["marker_id"].broadcast(count, np.int64).tolist()
    for name, trial, marker_id in zip(names, trials.tolist(), wanted, strict=True):
        length = len(records[name].paths)
        number = trial % length if simulated else trial
        if number >= length or marker_id not in ids[name]:
            raise PluginError(f"{plain(name)}: it has {length} photographs; trial {number} of "
                              f"marker_id {marker_id} is not among them")
        places.append((name, number, ids[name].index(marker_id)))
    rotation, translation, source, std = (
        np.array([getattr(records[name], field)[number, marker] for name, number, marker in places])
        for field in ("rotation", "translation", "source", "std"))
    with np.errstate(invalid="ignore"):
        tilt, azimuth, roll = (np.degrees(each) for each in angles_of_rotation(rotation))
    columns: dict[str, Any] = {
        "on_board": [boards[name][marker] for name, _, marker in places],
        "x_m": translation[:, 0], "y_m": translation[:, 1], "distance_m": translation[:, 2],
        "resolved_tilt_deg": tilt, "resolved_azimuth_deg": azimuth, "resolved_roll_deg": roll,
        "truth": source, "truth_std": std,
        "absent": np.where(source == TruthSource.none, DetectionStatus.no_board,
                           DetectionStatus.not_in_photograph),
    }
    if simulated:
        columns["neighbourhood"] = [each and with_neighbours(
            each, float(np.ceil(clear_modules(each))) + BESIDE_MODULES)
            for each in columns["on_board"]]
    else:
        images = {
            (name, number): reference((Path(folder) / name).parent / records[name].paths[number],
                                      records[name].digests[number], records[name].part)
            for name, number, _ in places}
        columns |= {"renderer": PHOTOGRAPH, "background": [images[place[:2]] for place in places]}
    return {name: Column.of(column) for name, column in columns.items()}
