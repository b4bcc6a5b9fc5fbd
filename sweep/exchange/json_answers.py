"""Answers in JSON: an object a line, or an array of objects."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from sweep.exchange.answer_reading import ALIASES, Reading, finish
from sweep.exchange.csv_rows import text_lines
from sweep.messages import plain


def json_answers(text: str, reading: Reading) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the line and content of each object of JSON Lines, or of a JSON array."""
    objects: Iterator[tuple[int, Any]]
    if text.lstrip().startswith("["):
        try:
            whole = json.loads(text)
        except (ValueError, RecursionError) as error:
            reading.fault(getattr(error, "lineno", 1), f"not JSON: {error}")
            return
        objects = iter(enumerate(whole, 1))
    else:
        objects = _json_lines(text, reading)
    for line, each in objects:
        if not isinstance(each, dict):
            reading.fault(line, 'expected an object such as {"image": ..., "id": ...}')
            continue
        content = {ALIASES.get(str(key).lower(), str(key).lower()): value
                   for key, value in each.items()}
        answer: dict[str, Any] = {"image": content.get("image")}
        parts = ("corners", "rvec", "quaternion", "tvec")
        if content.get("id") is None and not any(content.get(name) for name in parts):
            yield line, answer
            continue
        answer["id"] = content.get("id")
        sound = True
        for name, shape in (
            ("corners", (4, 2)), ("rvec", (3,)), ("quaternion", (4,)), ("tvec", (3,))
        ):
            if content.get(name) is not None:
                values = _array(content[name], shape)
                if values is None:
                    numbers = "4 pairs of finite numbers" if name == "corners" \
                        else f"{shape[0]} finite numbers"
                    reading.fault(line, f"{name} = {plain(content[name])}: expected {numbers}")
                    sound = False
                    break
                answer[name] = values
        if not sound:
            continue
        angles = answer.pop("quaternion", None)
        angles = answer.pop("rvec", None) if angles is None else angles
        position = answer.pop("tvec", None)
        if (angles is None) != (position is None):
            reading.fault(line, "half a pose; expected tvec, and rvec or quaternion")
            continue
        if angles is not None and position is not None:
            answer["pose"] = [*angles, *position]
        if finish(reading, line, answer):
            yield line, answer


def _json_lines(text: str, reading: Reading) -> Iterator[tuple[int, Any]]:
    for line, written in enumerate(text_lines(text), 1):
        if not written.strip():
            continue
        try:
            yield line, json.loads(written)
        except (ValueError, RecursionError):
            reading.fault(line, "not JSON; expected one object a line")


def _array(value: Any, shape: tuple[int, ...]) -> list[float] | None:
    """Return the finite numbers of nested lists of a shape, in order; None if they are not."""
    try:
        values = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if values.size == math.prod(shape) and values.ndim == 1 and len(shape) == 2:
        values = values.reshape(shape)
    if values.shape != shape or not np.isfinite(values).all() or _has_text(value):
        return None
    return [float(number) for number in values.ravel()]


def _has_text(value: Any) -> bool:
    if isinstance(value, list):
        return any(_has_text(each) for each in value)
    return isinstance(value, (str, bool))
