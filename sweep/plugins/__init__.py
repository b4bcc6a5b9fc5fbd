"""What the author of a plug-in imports: the records that declare one, and its settings.

A plug-in is found by the name of an entry point (groups ``sweep.detectors``, ``sweep.estimators``,
``sweep.effects``, ``sweep.renderers``), or as ``module:name`` in a file beside the pipeline. What
stands there is one of these records, or just what their first field takes. Importing this is quick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from sweep.declaration import parameter

__all__ = ["DetectorPlugin", "Markers", "Plugin", "parameter"]


class Markers(NamedTuple):
    """What a detector returns for an image; a plain tuple of the first two does as well.

    Attributes
    ----------
    corners
        (n, 4, 2) px, in the conventions that the plug-in declares.
    ids
        (n,) whole numbers.
    rejected
        (m, 4, 2) quadrilaterals that were not decoded.
    """

    corners: Any
    ids: Any
    rejected: Any = ()


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """What all plug-ins declare.

    Attributes
    ----------
    settings
        A frozen dataclass whose fields are declared by :func:`parameter`, with defaults: they
        become parameters of pipeline files, and axes. None: no settings.
    meaning
        One line for listings.
    distribution
        The distribution, or several, that results depend on: their versions are recorded, must be
        the same on all workers, and one that is missing is reported with the command `install`.
    install
        How to install it (default: ``pip install`` and the distribution).
    """

    kind: ClassVar[str]
    settings: type[Any] | None = None
    meaning: str = ""
    distribution: str | Sequence[str] = ()
    install: str = ""

    @property
    def distributions(self) -> tuple[str, ...]:
        """The distributions that results depend on."""
        if isinstance(self.distribution, str):
            return (self.distribution,) if self.distribution else ()
        return tuple(self.distribution)


@dataclass(frozen=True, kw_only=True)
class DetectorPlugin(Plugin):
    """A detector of markers.

    Attributes
    ----------
    make
        Called once for each setting, family and process, and never pickled: ``make(settings,
        family)`` with an instance of `settings` (None without) and the plug-in's own name of the
        dictionary. Returns a function of an image, (h, w) ``uint8``, contiguous and the function's
        own, that returns :class:`Markers`.
    pixel_center
        The coordinate of the first pixel's centre in x and y: 0 as in OpenCV, or 0.5.
    corner_order
        The index among its four corners of those that are top left, top right, bottom right and
        bottom left in the marker's bitmap as OpenCV's dictionary has it.
    families
        Name of a dictionary -> the plug-in's name of it; other dictionaries are refused. None: all
        dictionaries, by their own names.
    margin_px
        Width of the border around the marker whose pixels can change the detection, px, or a
        function from the settings to it: only this is searched. None: the whole frame is.
    threads
        Threads that a search uses; runs have a process a processor, so that 1 suits them.
    """

    kind: ClassVar[str] = "detector"
    make: Callable[[Any, str], Callable[[Any], Any]]
    pixel_center: float = 0.0
    corner_order: tuple[int, int, int, int] = (0, 1, 2, 3)
    families: Mapping[str, str] | None = field(default=None, hash=False)
    margin_px: int | Callable[[Any], int] | None = None
    threads: int = 1

    def __post_init__(self) -> None:
        """Refuse conventions that cannot be."""
        if sorted(self.corner_order) != [0, 1, 2, 3]:
            raise ValueError(
                f"corner_order = {self.corner_order!r}: expected the numbers 0 to 3, each once"
            )
        if not -1 <= self.pixel_center <= 1:
            raise ValueError(f"pixel_center = {self.pixel_center!r}: expected 0 or 0.5")
        if not callable(self.make):
            raise TypeError("make: expected a class or function of settings and family")


RECORDS: dict[str, type[Plugin]] = {record.kind: record for record in (DetectorPlugin,)}
"""Kind of plug-in -> its record."""
