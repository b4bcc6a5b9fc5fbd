"""Coordinates of the dataset beside its axes: what is fixed, and what is drawn for each scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import label
from sweep.model.calibration_error import VIEW, CalibrationError
from sweep.model.columns import Column
from sweep.plan.alternatives import superseded
from sweep.plan.axes import MAX_DEVIATIONS, Distribution
from sweep.plan.beliefs import CALIBRATED, believed_calibration
from sweep.plan.parameters import PARAMETERS, Parameter
from sweep.typing import Floats

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline

ALWAYS_GIVEN = ("marker", "pose")
"""Sections whose fixed parameters are coordinates also where the file does not give them."""

CALIBRATION_SCALE_PX = 1e4
"""Size of a camera's numbers in pixels by which rounding of a calibration's is measured."""


FIXED = "fixed"
"""Attribute of the coordinates of fixed parameters; tables of analyses leave them out."""


@dataclass(frozen=True, slots=True)
class FixedValue:
    """A parameter with one value on the whole grid: a coordinate without dimensions.

    Attributes
    ----------
    name
        The parameter's.
    value
        A number, a truth value, or a text (a list of numbers as "0.1, 0").
    attributes
        Meaning as ``long_name``, :data:`FIXED`, and ``units`` if it has a unit.
    """

    name: str
    value: float | bool | str
    attributes: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class DrawnQuantity:
    """A number of each scene that is drawn, or follows from one that is.

    Attributes
    ----------
    name
        Of the coordinate: the parameter's name.
    column
        Its name among the scene's values (:func:`sweep.plan.grid.scene_values`).
    meaning, unit
        What it means, and its ``units``.
    scale
        The largest numbers that it is added up from, by which rounding is measured; 0 if it is
        a product.
    """

    name: str
    column: str
    meaning: str
    unit: str
    scale: float

    def of(self, values: Mapping[str, Column], count: int) -> Floats:
        """Return its values (count,) among those of scenes."""
        return values[self.column].broadcast(count)


def fixed_values(pipeline: Pipeline) -> list[FixedValue]:
    """Return the fixed parameters that are coordinates, in the order of their declaration.

    They are those of marker and pose that have a value (unless the pose is given otherwise), and
    all that the pipeline gives.
    """
    without = superseded(pipeline.given)
    return [
        FixedValue(parameter.name, value, _attributes(parameter))
        for parameter in pipeline.parameters.values()
        if parameter.section in ALWAYS_GIVEN or parameter.name in pipeline.given
        if parameter.name not in without
        if (value := _scalar(pipeline.fixed.get(parameter.name))) is not None
    ]


def _scalar(value: Any) -> float | bool | str | None:
    return label(value) if isinstance(value, tuple) else value


def _attributes(parameter: Parameter) -> dict[str, str]:
    unit = {"units": parameter.unit} if parameter.unit else {}
    return {"long_name": parameter.declaration.meaning, FIXED: "on the whole grid", **unit}


def drawn_quantities(pipeline: Pipeline) -> list[DrawnQuantity]:
    """Return what is drawn for each scene of a pipeline, except the noise of pixels.

    Examples
    --------
    >>> from sweep.plan.experiment import Pipeline
    >>> pipeline = Pipeline.from_dict({"pose": {"side_px": {"uniform": [20, 40]}}})
    >>> [quantity.name for quantity in drawn_quantities(pipeline)]
    ['side_px', 'distance_m']
    """
    quantities = [
        _of_parameter(pipeline.parameters[name], _scale(distribution))
        for name, distribution in pipeline.distributions.items()
    ]
    if "side_px" in pipeline.distributions:
        quantities.append(_of_parameter(PARAMETERS["distance_m"], 0.0))
    jitter = [float(value) for value in pipeline.values_of("jitter_px")]
    if any(jitter):
        quantities += [
            DrawnQuantity(
                f"jitter_{axis}_px", f"shift_{axis}_px",
                f"shift of the centre's undistorted projection along {axis}", "px", max(jitter),
            )
            for axis in ("u", "v")
        ]
    error = believed_calibration(pipeline.fixed, pipeline.values_of("believed"))
    if error is not None:
        quantities += [_calibrated(error, name) for name in error.names]
    return quantities


def _calibrated(error: CalibrationError, name: str) -> DrawnQuantity:
    """Return a number of the camera that a calibration gives."""
    unit = "px" if name in VIEW else ""
    return DrawnQuantity(
        f"believed_{name}", CALIBRATED + name, f"{name.removesuffix('_px')} as a calibration "
        "gives it, for estimators that believe it", unit,
        (CALIBRATION_SCALE_PX if unit else 1.0) + MAX_DEVIATIONS * error.sd(name),
    )


def _of_parameter(parameter: Parameter, scale: float) -> DrawnQuantity:
    return DrawnQuantity(
        parameter.name, parameter.name, parameter.declaration.meaning, parameter.unit, scale
    )


def _scale(distribution: Distribution) -> float:
    """Return the largest number that a draw is added up from."""
    a, b = abs(distribution.a), abs(distribution.b)
    return float(np.maximum(a, b * (MAX_DEVIATIONS if distribution.kind == "normal" else 1.0)))
