"""Random draws: a function of (seed, quantity, geometry key, trial), and of nothing else.

The geometry key of a cell is the text of its own camera, marker and pose values: canonical
(``side_px`` as ``distance_m``, a camera in mm as one in pixels), sorted by name, defaults left
out, numbers rounded to 12 significant digits. Whether a value is fixed or an axis, in which
order and on which grid, does not matter; nor do renderer, window, levels, detector or estimator.
"""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.model.camera import VIEW_PARAMETERS, canonical_distortion, intrinsics
from sweep.model.splitmix import mixed
from sweep.plan.axes import Distribution
from sweep.plan.parameters import GEOMETRY_SECTIONS, PARAMETERS

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
      if p.section in GEOMETRY_SECTIONS
      and p.name not in (*VIEW_PARAMETERS, "distortion", "side_px")),
)


def _text(value: Any) -> str:
    """Return a value's canonical text."""
    if isinstance(value, str):
        return value.upper()
    if isinstance(value, tuple):
        return ",".join(_text(item) for item in canonical_distortion(value))
    return f"{float(value) + 0.0:.12g}"


def _texts(name: str, value: Any, default: Any) -> str | list[str]:
    """Return "name=value", empty where the value is the default; a list where scenes differ."""
    left_out = None if default is None else _text(default)

    def labelled(item: Any) -> str:
        text = _text(item)
        return "" if text == left_out else f"{name}={text}"

    if not isinstance(value, (np.ndarray, list)):
        return labelled(value)
    items = value.tolist() if isinstance(value, np.ndarray) else value
    known = {item: labelled(item) for item in dict.fromkeys(items)}
    return [known[item] for item in items]


def geometry_keys(
    values: Mapping[str, Any], distributions: Mapping[str, Distribution], count: int
) -> NDArray[np.uint64]:
    """Return the hashed geometry keys (count,) of scenes.

    ``values`` has every parameter of camera, marker and pose that is not drawn, one value for
    all scenes or one each, with ``distance_m`` resolved from ``side_px``.
    """
    fx, fy, cx, cy = intrinsics(*(values[name] for name in VIEW_PARAMETERS))
    columns: dict[str, str | list[str]] = {
        name: _texts(name, value, default)
        for name, value, default in (
            ("fx_px", fx, _DEFAULT_VIEW["fx_px"]),
            ("fy_px", fy, _DEFAULT_VIEW["fy_px"]),
            ("distortion", values["distortion"], ()),
        )
    }
    for name, length in (("cx_px", "width_px"), ("cy_px", "height_px")):
        if values[name] is not None:
            given = _texts(name, cx if name == "cx_px" else cy, None)
            middles = _texts(name, (values[length] - 1) / 2, None)
            pairs = zip(_each(given, count), _each(middles, count), strict=True)
            columns[name] = ["" if text == middle else text for text, middle in pairs]
    for name in _PLAIN:
        if name not in distributions and values.get(name) is not None:
            columns[name] = _texts(name, values[name], PARAMETERS[name].default)
    for name, distribution in distributions.items():
        if PARAMETERS[name].section in GEOMETRY_SECTIONS:
            columns[name] = f"{name}={distribution}"
    used = [columns[name] for name in sorted(columns) if any(columns[name])]
    if all(isinstance(column, str) for column in used):
        return np.full(count, _hash("|".join(column for column in used if isinstance(column, str))))
    texts = zip(*(_each(column, count) for column in used), strict=True)
    keys = ["|".join(filter(None, parts)) for parts in texts]
    known = {key: _hash(key) for key in dict.fromkeys(keys)}
    return np.array([known[key] for key in keys], dtype=np.uint64)


def _each(texts: str | list[str], count: int) -> list[str]:
    return [texts] * count if isinstance(texts, str) else texts


def _hash(text: str) -> np.uint64:
    """Return 64 bits of a text's BLAKE2b hash."""
    return np.uint64(int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little"))


_STEP = np.uint64(0x9E3779B97F4A7C15)


def uniform(
    seed: int, quantity: str, keys: NDArray[np.uint64], trials: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return one uniform number in (0, 1) for each scene's geometry key and trial (N,).

    (seed, quantity) is hashed by BLAKE2b, as the keys are; trials are steps of SplitMix64 from
    there. 53 bits, the middle of their cell, so that neither end occurs.
    """
    return np.asarray(((bits(seed, quantity, keys, trials) >> np.uint64(11)) + 0.5) * 2.0**-53)


def bits(
    seed: int, quantity: str, keys: NDArray[np.uint64], trials: NDArray[np.int64]
) -> NDArray[np.uint64]:
    """Return 64 random bits for each scene, as :func:`uniform`."""
    start = mixed(keys ^ _hash(f"{seed}\n{quantity}"))
    return np.asarray(mixed(start + _STEP * (np.asarray(trials).astype(np.uint64) + np.uint64(1))))
