"""Random draws: a function of (seed, quantity, geometry key, trial), and of nothing else.

The geometry key of a cell is the text of its own camera, marker and pose values: canonical
(a camera in mm as one in pixels, the pose in whichever way it is given as tilt, azimuth, roll,
distance and bearings, unless these depend on a draw), sorted by name, defaults left out, numbers
rounded to 12 significant digits. Whether a value is fixed or an axis, in which
order and on which grid, does not matter; nor do renderer, window, levels, detector or estimator.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cache
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.model.camera import VIEW_PARAMETERS, canonical_distortion, intrinsics
from sweep.model.columns import Column, map_columns
from sweep.model.splitmix import mixed
from sweep.plan.axes import Distribution
from sweep.plan.parameters import GEOMETRY_SECTIONS, PARAMETERS
from sweep.plan.pose_values import canonical_pose
from sweep.plan.sobol import sobol_uniform
from sweep.typing import Floats, Integers

_DEFAULT_VIEW = dict(
    zip(
        ("fx_px", "fy_px"),
        intrinsics(*(PARAMETERS[name].default for name in VIEW_PARAMETERS))[:2],
        strict=True,
    )
)
_PLAIN = (
    "width_px", "height_px",
    *(p.name for p in PARAMETERS.values()
      if p.section in GEOMETRY_SECTIONS and p.section != "camera" and p.name != "side_px"),
)


def _text(value: Any) -> str:
    """Return the canonical text of a value."""
    if isinstance(value, str):
        return value.upper()
    if isinstance(value, tuple):
        return ",".join(_text(item) for item in canonical_distortion(value))
    return f"{float(value) + 0.0:.12g}"


def _texts(name: str, column: Column, default: Any) -> Column:
    """Return "name=value" of each value, empty where it is the default."""
    left_out = None if default is None else _text(default)

    @cache
    def labelled(value: Any) -> str:
        text = _text(value)
        return "" if text == left_out else f"{name}={text}"

    return column.map(labelled)


def geometry_keys(
    values: Mapping[str, Column], distributions: Mapping[str, Distribution], count: int
) -> NDArray[np.uint64]:
    """Return the hashed geometry keys (count,) of scenes.

    ``values`` has every parameter of camera, marker and pose that is not drawn.
    """
    values = canonical_pose(values, distributions)
    fx, fy, cx, cy = map(Column.of, intrinsics(*(values[name].values for name in VIEW_PARAMETERS)))
    columns = {
        "fx_px": _texts("fx_px", fx, _DEFAULT_VIEW["fx_px"]),
        "fy_px": _texts("fy_px", fy, _DEFAULT_VIEW["fy_px"]),
        "distortion": _texts("distortion", values["distortion"], ()),
    }
    for name, centre, length in (("cx_px", cx, "width_px"), ("cy_px", cy, "height_px")):
        if not values[name].missing:
            middle = Column.of((values[length].values - 1) / 2)
            columns[name] = map_columns(
                lambda text, default: "" if text == default else text,
                [_texts(name, centre, None), _texts(name, middle, None)],
            )
    for name in _PLAIN:
        if name not in distributions and name in values and not values[name].missing:
            columns[name] = _texts(name, values[name], PARAMETERS[name].default)
    for name, distribution in distributions.items():
        if name in PARAMETERS and PARAMETERS[name].section in GEOMETRY_SECTIONS:
            columns[name] = Column.of(f"{name}={distribution}")
    used = [columns[name] for name in sorted(columns) if columns[name].differs_from("")]
    joined = map_columns(lambda *texts: "|".join(filter(None, texts)), used)
    return joined.map(cache(_hash)).broadcast(count, np.uint64)


def _hash(text: str) -> np.uint64:
    """Return 64 bits of a text's BLAKE2b hash."""
    return np.uint64(int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little"))


_STEP = np.uint64(0x9E3779B97F4A7C15)


def uniform(
    seed: int, quantity: str, keys: NDArray[np.uint64], trials: Integers
) -> Floats:
    """Return uniform numbers in (0, 1) of scenes, by geometry key and trial, (N,) each.

    (seed, quantity) is hashed by BLAKE2b, as the keys are; trials are steps of SplitMix64 from
    there. 53 bits, in the middle of their interval, so that neither 0 nor 1 occurs.
    """
    return np.asarray(((bits(seed, quantity, keys, trials) >> np.uint64(11)) + 0.5) * 2.0**-53)


SAMPLINGS = ("independent", "sobol")
"""How the draws of a cell's trials relate: not at all, or so that they fill their space evenly."""


def jointly_drawn(distributions: Collection[str], others: Sequence[str] = ()) -> list[str]:
    """Return the quantities that are drawn together, each at its dimension of Sobol's points.

    The jitter comes after the distributions, so that whether there is any changes nothing for them;
    then come ``others``.
    """
    return [*sorted(distributions), "shift_u_px", "shift_v_px", *others]


def even_uniform(
    seed: int, quantity: str, quantities: Sequence[str], keys: NDArray[np.uint64], trials: Integers
) -> Floats:
    """Return uniform numbers in (0, 1) of scenes that fill the space of ``quantities`` evenly.

    They are scrambled by (seed, quantity, geometry key, number of the replicate); the other
    arguments are as of :func:`uniform`.
    """
    start = mixed(keys ^ _hash(f"{seed}\nsobol\n{quantity}"))
    return sobol_uniform(quantities.index(quantity), start, trials)


def bits(
    seed: int, quantity: str, keys: NDArray[np.uint64], trials: Integers
) -> NDArray[np.uint64]:
    """Return 64 random bits for each scene (arguments as :func:`uniform`)."""
    start = mixed(keys ^ _hash(f"{seed}\n{quantity}"))
    return np.asarray(mixed(start + _STEP * (np.asarray(trials).astype(np.uint64) + np.uint64(1))))
