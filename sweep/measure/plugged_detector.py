"""A plug-in's detector: its conventions are turned into ours, and what it returns is checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.measure.detector import DetectorOutput
from sweep.plugins import DetectorPlugin
from sweep.plugins.calls import call, real_numbers
from sweep.typing import Floats

MAX_MARKERS = 1000
"""Markers, or candidates, that are believed of an image with one marker."""


class PluggedDetector:
    """One setting of a plug-in's detector in this process.

    Parameters
    ----------
    name
        The plug-in's, for messages.
    record
        Its declaration.
    settings
        An instance of its settings; None without.
    """

    def __init__(self, name: str, record: DetectorPlugin, settings: Any) -> None:
        self._name = name
        self._record = record
        self._settings = settings
        self._searches: dict[str, Callable[[NDArray[np.uint8]], Any]] = {}

    def find(
        self, image: NDArray[np.uint8], dictionary: str, frame_side: int  # noqa: ARG002
    ) -> DetectorOutput:
        """Search an image (h, w) for markers of a dictionary; the frame's side does not matter.

        Raises
        ------
        PluginError
            If the plug-in raises, or returns what cannot be a detection; in one line.
        """
        search = self._searches.get(dictionary) or self.make(dictionary)
        own = np.array(image, order="C")  # what it does to its image reaches nobody else
        returned = call(self._name, search, own)
        if not np.array_equal(own, image):
            raise PluginError(f"{self._name}: changed the image that it was given; copy it first")
        return self._checked(returned)

    def make(self, dictionary: str) -> Callable[[NDArray[np.uint8]], Any]:
        """Return the plug-in's search for markers of a dictionary, made once.

        Raises
        ------
        PluginError
            If it does not have the dictionary, or cannot be made; in one line.
        """
        families = self._record.families
        if families is not None and dictionary not in families:
            raise PluginError(
                f"{self._name}: no dictionary {dictionary}; it has {', '.join(families)}"
            )
        family = dictionary if families is None else families[dictionary]
        search = call(self._name, self._record.make, self._settings, family)
        if not callable(search):
            raise PluginError(
                f"{self._name}: make returns a {type(search).__name__}, not a function"
            )
        made: Callable[[NDArray[np.uint8]], Any] = search
        self._searches[dictionary] = made
        return made

    def _checked(self, returned: Any) -> DetectorOutput:
        """Return what a plug-in returned in our conventions."""
        if not isinstance(returned, tuple) or len(returned) not in (2, 3):
            raise PluginError(
                f"{self._name}: returned a {type(returned).__name__}; expected a tuple "
                "(corners, ids), or with rejected quadrilaterals as the third"
            )
        corners = self._quadrilaterals("corners", returned[0])
        rejected = self._quadrilaterals("rejected", returned[2] if len(returned) > 2 else ())
        try:
            ids = np.asarray(returned[1])
        except Exception:
            raise PluginError(f"{self._name}: returned ids that are no array") from None
        if ids.size == 0 and len(corners) == 0:
            return [], None, list(rejected[:, None])
        if ids.shape != (len(corners),):
            raise PluginError(
                f"{self._name}: returned ids of shape {ids.shape}; expected ({len(corners)},), "
                "one of each marker"
            )
        if ids.dtype.kind not in "iu":
            raise PluginError(
                f"{self._name}: returned ids of type {ids.dtype}; expected whole numbers"
            )
        if np.ma.is_masked(returned[1]):
            raise PluginError(f"{self._name}: returned ids of which some are masked")
        if (ids > np.iinfo(np.int64).max).any():
            raise PluginError(f"{self._name}: returned the ID {ids.max()}; expected below 2^63")
        if (ids < 0).any():
            raise PluginError(f"{self._name}: returned the ID {ids.min()}; expected at least 0")
        return list(corners[:, None]), ids.astype(np.int64), list(rejected[:, None])

    def _quadrilaterals(self, what: str, returned: Any) -> Floats:
        """Return corners (n, 4, 2) in our order, with pixel centres at whole numbers."""
        quads = real_numbers(self._name, what, returned)
        if quads.size == 0 and quads.shape[:1] in ((0,), (1,)):
            return np.empty((0, 4, 2))
        if quads.ndim != 3 or quads.shape[1:] != (4, 2):
            raise PluginError(
                f"{self._name}: returned {what} of shape {quads.shape}; expected (n, 4, 2)"
            )
        if len(quads) > MAX_MARKERS:
            raise PluginError(
                f"{self._name}: returned {len(quads):,} {what} for one image; expected at most "
                f"{MAX_MARKERS:,}"
            )
        if not np.isfinite(quads).all():
            raise PluginError(f"{self._name}: returned {what} that are not finite")
        return quads[:, self._record.corner_order] - self._record.pixel_center
