"""A target that a table of markers declares: each has a size and a pose of its own."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from sweep.declaration import check_tables, declared_fields, parameter
from sweep.model.board import (
    Board,
    Print,
    corners_of,
    marker_print,
    rectangles_print,
    solid_print,
)
from sweep.model.board_declaring import (
    Fault,
    dictionary_of_all,
    id_faults,
    length,
    margin,
    refuse,
    required,
)
from sweep.model.board_overlap import first_overlap
from sweep.model.marker import OUTSIDE, WHITE, module_count, overhang
from sweep.typing import Floats


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BoardMarker:
    """One of a table of markers."""

    marker_id: int = required("the marker's ID in its dictionary", low=0, high=10**6)
    x_m: float = required("its centre, right of the origin", unit="m", low=-1e6, high=1e6)
    y_m: float = required("its centre, above the origin", unit="m", low=-1e6, high=1e6)
    size_m: float = length("side of its black square")
    roll_deg: float = parameter(
        0.0, "its turn in its plane, from x to y", unit="degree", low=-360, high=360
    )
    z_m: float = parameter(
        0.0, "height of its centre over the board's plane", unit="m", low=-1e6, high=1e6
    )
    tilt_deg: float = parameter(
        0.0, "angle between its plane and the board's", unit="degree", low=-180, high=180
    )
    azimuth_deg: float = parameter(
        0.0, "direction of the axis of this tilt in the board's plane, from x to y", unit="degree",
        low=-360, high=360,
    )

    @property
    def is_flat(self) -> bool:
        """Whether it is in the board's plane."""
        return self.z_m == self.tilt_deg == 0.0


_TABLES = "tables [[markers]]"


def _read_markers(value: Any) -> tuple[BoardMarker, ...]:
    rows = check_tables(declared_fields(BoardMarker), value, "a marker", _TABLES)
    return tuple(BoardMarker(**row) for row in rows)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Markers:
    """A table of markers, each on a sheet of its own or, in one plane, all on one."""

    dictionary: str = dictionary_of_all()
    markers: tuple[BoardMarker, ...] = required(
        "one for each", list_text=_TABLES, reads=_read_markers
    )
    quiet_zone_modules: float | None = parameter(
        None, "width of the white that surrounds each marker on its own sheet (default: 1)",
        unit="module", low=0, high=100,
    )
    margin_m: float | None = margin(
        "width of the one white sheet beyond all markers; without it each has its own"
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return len(self.markers), 0

    def faults(self) -> list[Fault]:
        """Return what keeps the values from being a board."""
        faults = []
        if self.margin_m is not None and self.quiet_zone_modules is not None:
            faults.append(Fault(
                "margin_m", self.margin_m,
                "margin_m (one sheet) or quiet_zone_modules (a sheet each), not both; delete one "
                "of them",
            ))
        ids = [each.marker_id for each in self.markers]
        faults += id_faults("markers", ids, self.dictionary)
        if self.margin_m is not None and not all(each.is_flat for each in self.markers):
            faults.append(Fault(
                "margin_m", self.margin_m, "no one sheet for markers in several planes; delete it"
            ))
        if not faults:
            pair = self._overlap()
            if pair is not None:
                quiet = "" if self.margin_m is not None else " with their quiet zones"
                faults.append(Fault(
                    "markers", [ids[i] for i in pair],
                    f"markers that do not overlap{quiet}; these two do",
                ))
        return faults

    def _overlap(self) -> tuple[int, int] | None:
        """Return the first two markers of the same plane that overlap, or None."""
        planes: dict[tuple[float, ...], list[int]] = {}
        centres = np.array([[each.x_m, each.y_m, each.z_m] for each in self.markers])
        for k, each in enumerate(self.markers):
            if not each.is_flat:
                printed, _ = solid_print(
                    self._print(each), each.z_m, each.tilt_deg, each.azimuth_deg
                )
                centres[k] = centres[k] @ printed.turn
            key = each.tilt_deg, each.azimuth_deg if each.tilt_deg else 0.0, round(centres[k, 2], 9)
            planes.setdefault(key, []).append(k)
        sides = self._sides()
        rolls = np.radians([each.roll_deg for each in self.markers])
        for some in planes.values():
            pair = first_overlap(centres[some, :2], sides[some], rolls[some])
            if pair is not None:
                return some[pair[0]], some[pair[1]]
        return None

    def _print(self, each: BoardMarker) -> Print:
        return marker_print(
            self.dictionary, each.marker_id, each.size_m, self._quiet, each.x_m, each.y_m,
            each.roll_deg,
        )

    def _sides(self) -> Floats:
        """Return the side (n,) of what is printed of each marker, with its quiet zone."""
        quiet = self._quiet or 0.0
        around = 1 + 2 * (overhang(self.dictionary) + quiet) / module_count(self.dictionary)
        return np.array([each.size_m * around for each in self.markers])

    @property
    def _quiet(self) -> float | None:
        if self.margin_m is not None:
            return None
        return 1.0 if self.quiet_zone_modules is None else self.quiet_zone_modules

    def board(self) -> Board:
        """Return the board; ValueError with its faults, a line each."""
        refuse(self.faults())
        prints = [self._print(each) for each in self.markers]
        corners = np.array([
            corners_of(each.size_m, each.x_m, each.y_m, each.roll_deg) for each in self.markers
        ])
        if not all(each.is_flat for each in self.markers):
            for k, each in enumerate(self.markers):
                prints[k], corners[k] = solid_print(
                    prints[k], each.z_m, each.tilt_deg, each.azimuth_deg
                )
        if self.margin_m is not None:
            printed = np.concatenate([
                corners_of(side, each.x_m, each.y_m, each.roll_deg)[:, :2] * [1.0, -1.0]
                for each, side in zip(self.markers, self._sides().tolist(), strict=True)
            ])
            box = [*(printed.min(axis=0) - self.margin_m), *(printed.max(axis=0) + self.margin_m)]
            prints.append(rectangles_print(np.array([box]), OUTSIDE, WHITE))
        return Board(
            self.dictionary, tuple(each.marker_id for each in self.markers), corners,
            tuple(prints), np.empty((0, 3)),
        )
