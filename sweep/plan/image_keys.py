"""A key of each image: a function of its scene's own parameters and draws, not of the grid.

By it an image that was exported is recognised again: on another grid that has the same scene, or
as a single cell. Keys are hashes of the texts of all parameters that change the image, sorted by
name, defaults left out, numbers rounded to 12 significant digits, mixed with the seed and the
trial.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.measure.bound import BoundSetting
from sweep.model.columns import Column, map_columns
from sweep.plan.axes import TRIAL
from sweep.plan.draws import bits
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes
from sweep.plan.parameters import Stage

NOT_IN_IMAGE = {
    "window", "camera_file", "calibration_sd", "calibration_covariance",
    *(field.name for field in dataclasses.fields(BoundSetting)),
}
"""Parameters of the scene's stage that do not change its image."""


def image_keys(pipeline: Pipeline, indices: Sequence[NDArray[np.intp]]) -> NDArray[np.uint64]:
    """Return the keys (N,) of the images of scenes at ``indices`` (N,) along each scene axis."""
    axes, parameters = scene_axes(pipeline), pipeline.parameters
    count = len(indices[0]) if axes else 1
    values = {
        name: Column(value, constant=True) for name, value in pipeline.fixed.items()
        if parameters[name].stage is Stage.scene
    }
    for axis, index in zip(axes, indices, strict=True):
        for name, along in axis.columns.items():
            values[name] = Column.of([along[i] for i in index.tolist()])
    trials = values.pop(TRIAL, Column(0, constant=True)).broadcast(count, np.int64)
    texts = [
        _texts(pipeline, name, values[name])
        for name in sorted(values.keys() - NOT_IN_IMAGE - pipeline.distributions.keys())
    ]
    texts += [
        Column.of(f"{name}={distribution}")
        for name, distribution in sorted(pipeline.distributions.items())
        if parameters[name].stage is Stage.scene
    ]
    used = [column for column in texts if column.differs_from("")]
    joined = map_columns(lambda *each: "|".join(filter(None, each)), used) if used \
        else Column.of("")
    keys = joined.map(_hash).broadcast(count, np.uint64)
    return bits(pipeline.seed, f"image {pipeline.sampling}", keys, trials)


def _texts(pipeline: Pipeline, name: str, column: Column) -> Column:
    """Return "name=value" of each value, empty where it is the default."""
    default = pipeline.parameters[name].default

    @cache
    def text(value: Any) -> str:
        if value is None or value == default:
            return ""
        if name == "background" and isinstance(value, str):
            return f"{name}={pipeline.files.get(value) or value}"
        return f"{name}={_text(value)}"

    return column.map(text)


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(_text(item) for item in value)
    return str(value) if isinstance(value, (str, bool)) else f"{float(value) + 0.0:.12g}"


@cache
def _hash(text: str) -> np.uint64:
    """Return 64 bits of a text's BLAKE2b hash."""
    return np.uint64(int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little"))
