"""Names that the author of a plug-in imports: the records that declare one, and its settings.

A plug-in is found by the name of an entry point (groups ``sweep.detectors``, ``sweep.estimators``,
``sweep.effects``, ``sweep.renderers``), or as ``module:name`` in a file beside the pipeline. What
stands there is one of these records, or just what their first field takes. Importing this is quick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, get_args

from sweep.declaration import parameter

__all__ = [
    "DetectorPlugin", "EffectPlugin", "EstimatorPlugin", "Markers", "Poses", "RendererPlugin",
    "parameter",
]


class Markers(NamedTuple):
    """Result of a detector for an image; a plain tuple of the first two does as well.

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


class Poses(NamedTuple):
    """Result of a solver for N detections; a plain tuple of the first two does as well.

    NaN where there is no solution. Poses take the marker's frame to the camera's: OpenCV's axes,
    metres.

    Attributes
    ----------
    rotation, translation
        (N, 3, 3) and (N, 3).
    covariance
        (N, 6, 6) as :class:`sweep.measure.estimation.Estimates` has it; None for none.
    alternative_rotation, alternative_translation
        The other planar solution; None for none.
    """

    rotation: Any
    translation: Any
    covariance: Any = None
    alternative_rotation: Any = None
    alternative_translation: Any = None


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """Declarations that all plug-ins share.

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

    settings: type[Any] | None = None
    meaning: str = ""
    distribution: str | Sequence[str] = ()
    install: str = ""

    def __post_init__(self) -> None:
        """Refuse values that no plug-in has."""
        for name in [each for each in EXPECTED if hasattr(self, each)]:
            (fits, expected), value = EXPECTED[name], getattr(self, name)
            # Of arrays lists and numbers: they are compared as a whole, not by element.
            if not fits(value.tolist() if hasattr(value, "tolist") else value):
                raise ValueError(f"{name} = {value!r}: expected {expected}")


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
    """

    make: Callable[[Any, str], Callable[[Any], Any]]
    pixel_center: float = 0.0
    corner_order: tuple[int, int, int, int] = (0, 1, 2, 3)
    families: Mapping[str, str] | None = field(default=None, hash=False)
    margin_px: int | Callable[[Any], int] | None = None


@dataclass(frozen=True, kw_only=True)
class EstimatorPlugin(Plugin):
    """A solver: from detections to poses.

    Attributes
    ----------
    make
        Called once for each setting and process, and never pickled: ``make(settings)`` with an
        instance of `settings` (None without). Returns a function of
        :class:`sweep.measure.estimation.Detections` of N targets that returns :class:`Poses`.
    needs_images
        Whether it uses the pixels: the detections' images are kept for it.
    of_boards
        Whether it estimates boards: the targets are boards then, of any number of squares; else
        markers, all of one.
    """

    make: Callable[[Any], Callable[[Any], Any]]
    needs_images: bool = False
    of_boards: bool = False


#: Why an effect makes more than the usual window be searched.
Widens = Literal["nothing", "noise", "uneven light"]


@dataclass(frozen=True, kw_only=True)
class EffectPlugin(Plugin):
    """A pointwise effect of the camera or its surroundings on the image.

    Its settings are numbers. The first is its switch: the effect is absent where that has its
    default.

    Attributes
    ----------
    apply
        ``apply(levels, patch)`` with levels (h, w) and their :class:`sweep.model.effects.Patch`
        returns the levels after it. The result must not depend on the window.
    step
        "light": on the light that falls on the pixels; "signal": on their signal, with its noise
        and gain, before quantisation. After the built-in effects of the step.
    random
        Whether it draws random numbers (``patch.normals``).
    widens
        Whether more than the usual window must be searched: "noise" or "uneven light".
    """

    apply: Callable[[Any, Any], Any]
    step: Literal["light", "signal"] = "light"
    random: bool = False
    widens: Widens = "nothing"


@dataclass(frozen=True, kw_only=True)
class RendererPlugin(Plugin):
    """A renderer of the marker. Its settings are numbers.

    Attributes
    ----------
    render
        A function of a :class:`sweep.model.effects.MarkerView` that returns two arrays
        (h, w) of the view's box: the marker's levels before quantisation, where the part of a pixel
        that the marker does not cover counts as 0, and the marker's share of each pixel.
    """

    render: Callable[[Any], Any]


#: Field of a record -> whether a value of it can be, and the expectation in words.
EXPECTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("make", "apply", "render"), (callable, "a class or function")),
    "distribution": (lambda names: isinstance(names, str | Sequence), "a name, or several"),
    "families": (lambda names: isinstance(names, Mapping | None), "names by dictionary, or None"),
    "pixel_center": (lambda at: hasattr(at, "__float__") and -1 <= at <= 1, "0 or 0.5"),
    "corner_order": (lambda order: hasattr(order, "__getitem__") and sorted(map(str, order)) == [
        *"0123"] and {*order} == {0, 1, 2, 3}, "the numbers 0 to 3, each once"),
    "step": (lambda step: step in ("light", "signal"), "light or signal"),
    "widens": (lambda widens: widens in get_args(Widens), "nothing, noise or uneven light"),
}

#: Kind of plug-in -> its record.
RECORDS: dict[str, type[Plugin]] = {
    "detector": DetectorPlugin, "estimator": EstimatorPlugin, "effect": EffectPlugin,
    "renderer": RendererPlugin}
