"""Tiles: the numbers at the top of a report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tile:
    """One number, with its name above and a detail below it."""

    heading: str
    value: str
    detail: str = ""
