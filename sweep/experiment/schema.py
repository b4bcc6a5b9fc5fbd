"""The schema of the dataset: variables, their attributes, and coordinates beside the axes."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.draws import CALIBRATED
from sweep.experiment.grid import MAX_DEVIATIONS, Axis, Grid
from sweep.experiment.parameters import IN_CAMERA, RIVALS, WORLD, Stage
from sweep.measure import flags
from sweep.measure.flags import DetectionStatus, Flag
from sweep.messages import label
from sweep.model.calibration import VIEW

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# Attributes of variables for readers: a short name for axes of charts, and the whole meaning.
#
# xarray labels the axes of its charts by ``long_name [units]``: a sentence there would be cut
# off. So ``long_name`` is the variable's name in words, and ``description`` says what it means.

#: The unit at the end of a name, or before the end of an interval.
UNIT = re.compile(r"_(m_s|deg_s|deg|rad|percent|px|mm|um|ms|m|s|e|grey|modules)(?=_low$|_high$|$)")

def short_name(name: str, units: str = "") -> str:
    """Return a variable's name in words, without its unit if it has one.

    Examples
    --------
    >>> short_name("rotation_p95_deg_low", "degree"), short_name("marker_id")
    ('rotation p95 low', 'marker id')
    >>> short_name("adaptiveThreshWinSizeMin", "px")
    'adaptiveThreshWinSizeMin'
    """
    return (UNIT.sub("", name) if units not in ("", "1") else name).replace("_", " ")


def with_description(name: str, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes with the ``long_name`` as ``description``, and a short one in its place.

    Those without a ``long_name``, or with both, stay as they are.

    Examples
    --------
    >>> with_description("tilt_deg", {"long_name": "angle to the image plane", "units": "degree"})
    {'long_name': 'tilt', 'description': 'angle to the image plane', 'units': 'degree'}
    """
    if "long_name" not in attributes or "description" in attributes:
        return dict(attributes)
    short = short_name(name, str(attributes.get("units", "")))
    return {"long_name": short, "description": attributes["long_name"],
            **{key: value for key, value in attributes.items() if key != "long_name"}}


def with_descriptions(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose variables and coordinates have short names; it shares the values."""
    described = dataset.copy(deep=False)
    for name, variable in described.variables.items():
        variable.attrs = with_description(str(name), variable.attrs)
    return described


# --------------------------------------------------------------------------------------------------
# Coordinates of the dataset beside its axes: fixed values, and values drawn for each scene.

#: Sections whose fixed parameters are coordinates also where the file does not give them.
ALWAYS_GIVEN = ("marker", "pose")

#: Size of a camera's numbers in pixels by which rounding of a calibration's is measured.
CALIBRATION_SCALE_PX = 1e4


#: Attribute of the coordinates of fixed parameters; tables of analyses leave them out.
FIXED = "fixed"


def fixed_values(pipeline: Grid) -> dict[str, tuple[float | bool | str, dict[str, str]]]:
    """Return value and attributes of the fixed parameters that are coordinates without dimensions.

    They are those of marker and pose that have a value (unless the pose is given otherwise), and
    all that the pipeline gives, in the order of their declaration; a list of numbers as a text.
    """
    given = pipeline.given
    without = {rival for name in given for rival in RIVALS.get(name, ())}
    if "photographs" in given:
        without = {*IN_CAMERA, *WORLD, "jitter_px"}
    elif not given.isdisjoint(WORLD):
        without = {*IN_CAMERA}
    return {
        each.name: (label(value) if isinstance(value, tuple) else value, {
            "long_name": each.meaning, FIXED: "on the whole grid",
            **({"units": each.unit} if each.unit else {})})
        for each in pipeline.parameters.values()
        if each.section in ALWAYS_GIVEN or each.name in pipeline.given
        if each.name not in without and (value := pipeline.fixed.get(each.name)) is not None
    }


# --------------------------------------------------------------------------------------------------
# The declaration of one variable of the dataset, and the dimensions that are no axes.

XYZ = ("x", "y", "z")
CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")

POSE_PARAMETERS = tuple(f"{part}_{axis}" for part in ("rotation", "translation") for axis in XYZ)

#: Coordinates of the dimensions that are no axes; of boards' they are numbers, from 0 on.
LABELS: dict[str, tuple[str, ...]] = {
    "corner": CORNERS, "xy": ("x", "y"), "xyz": XYZ, "pose_parameter": POSE_PARAMETERS,
    "marker": (), "chessboard_corner": (),
}


def cf_attributes(
    meaning: str, units: str = "", flags: type[IntEnum] | None = None
) -> dict[str, Any]:
    """Return the attributes of a variable, after the CF conventions.

    `sweep.experiment.schema.with_description` gives it a short ``long_name`` for readers.
    """
    known = {} if flags is None else {
        "flag_values": [int(flag) for flag in flags],
        "flag_meanings": " ".join(flag.name for flag in flags)}
    return {"long_name": meaning, **({"units": units} if units else {}), **known}


@dataclass(frozen=True, slots=True)
class FlagRule:
    """Where a flag variable demands or forbids the numbers of another variable.

    Attributes
    ----------
    flag
        Name of the flag variable. "Present" below means that its flag says that the numbers of
        its stage exist.
    number
        "always": a number wherever the flag is present, NaN elsewhere; "only": NaN wherever the
        flag is not present; "unless_lost": a number unless every flag of the scene is in
        :data:`LOST`; "if_seen": a number unless every flag of the scene is in :data:`UNSEEN`.
    """

    flag: str
    number: Literal["always", "only", "unless_lost", "if_seen"]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far a recomputation on another processor may lie from a stored value.

    On a processor with the same features every bit agrees. The limits were measured on 9,000
    scenes with AVX-512, AVX2 and all of AVX switched off in turn.

    Attributes
    ----------
    kind
        "equal": no difference; "absolute": of each number; "relative": of each number;
        "length": of each component, relative to the stored vector's norm; "distance": norm of
        the difference, relative to the marker's true distance; "rotation": angle in radians
        between the two rotation vectors' rotations.
    limit
        The largest difference, in the variable's unit where ``kind`` is "absolute".
    """

    kind: Literal["equal", "absolute", "relative", "length", "distance", "rotation"]
    limit: float = 0.0


#: Detections of a scene for which not even the truth may be known.
LOST = (
    DetectionStatus.failed, DetectionStatus.crashed, DetectionStatus.not_needed,
    DetectionStatus.not_in_photograph, DetectionStatus.no_board,
)

#: Detections of a scene in which a corner may be behind the camera: the marker has no image.
UNSEEN = (*LOST, DetectionStatus.not_visible)

#: Of the true pose (relative to its length) and of the marker's area.
TRUTH_RTOL = 1e-12

#: Of the accuracy bound's numbers: they pass through the inverse of a 6 x 6 matrix.
BOUND_RTOL = 1e-6

#: Of corners and of the reprojection error.
CORNER_ATOL_PX = 1e-2

#: Also, in degrees, of the angles that follow from the rotation: they change by no more.
ROTATION_ATOL_RAD = 1e-4

#: Relative to the marker's distance.
TRANSLATION_RTOL = 1e-4


@dataclass(frozen=True, slots=True)
class Variable:
    """One variable of the dataset: the record from which everything else about it follows.

    Attributes
    ----------
    name
        Its name in the dataset.
    stage
        The stage that makes it. It has the axes of this stage and of those before.
    dtype
        NumPy's type string, as stored.
    meaning, units
        Its ``description``, and its ``units``.
    inner
        Names of its dimensions beside the axes: keys of :data:`LABELS`.
    flags
        The flags that it takes its values from; None for a number.
    present_when
        The flag variable that says where its number exists; None where none does.
    tolerance
        How far another processor may lie from its stored value; None if it is not compared there.
        No scene may lie outside the tolerance of a scene's variable, few may outside the others'.
    drawn_as
        Name among the scene's values of the drawn quantity that it holds; such a variable is a
        coordinate of the dataset. Empty for computed variables.
    lengths
        Length of each inner dimension without labels, which differs from pipeline to pipeline.

    Examples
    --------
    >>> from sweep.experiment.schema import VARIABLES
    >>> variable = VARIABLES["corner_error_px"]
    >>> variable.stage.name, variable.inner_shape, variable.units
    ('detection', (4, 2), 'px')
    """

    name: str
    stage: Stage
    dtype: str
    meaning: str
    units: str = ""
    inner: tuple[str, ...] = ()
    flags: type[Flag] | None = None
    present_when: FlagRule | None = None
    tolerance: Tolerance | None = None
    drawn_as: str = ""
    lengths: tuple[tuple[str, int], ...] = ()

    @property
    def fill(self) -> float | int:
        """The value of cells that were not computed: NaN, or the flag ``not_run``."""
        return 0 if self.flags is not None else float("nan")

    @property
    def not_needed(self) -> float | int:
        """The value of cells that were not needed: NaN, or the flag ``not_needed``."""
        return self.fill if self.flags is None else int(
            getattr(self.flags, "not_needed", self.fill))

    @property
    def inner_shape(self) -> tuple[int, ...]:
        """Lengths of the inner dimensions."""
        lengths = dict(self.lengths)
        return tuple(lengths.get(name, len(LABELS[name])) for name in self.inner)

    def fitted(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return another store's values (..., inner) cut or filled to this one's inner lengths.

        A store's boards have as many markers as the largest of its grid: what is cut or filled
        lies beyond the boards of the cells that two grids share.
        """
        lengths, outer = self.inner_shape, values.ndim - len(self.inner_shape)
        beyond = DetectionStatus.not_on_board if self.flags is DetectionStatus else self.fill
        result = np.full((*values.shape[:outer], *lengths), beyond, dtype=values.dtype)
        shared: Any = (..., *map(slice, np.minimum(lengths, values.shape[outer:])))
        result[shared] = values[shared]
        return result

    def axes(self, pipeline: Grid) -> tuple[Axis, ...]:
        """Return its axes in the pipeline's order: those of its stage and of the stages before."""
        return tuple(axis for axis in pipeline.axes if axis.stage <= self.stage)

    def configuration_axes(self, pipeline: Grid) -> tuple[Axis, ...]:
        """Return the axes of detection and estimation that it has, stage by stage.

        They span its configurations, the last axis fastest; a scene's variable has none.
        """
        settings = (axis for axis in self.axes(pipeline) if axis.stage is not Stage.scene)
        return tuple(sorted(settings, key=lambda axis: axis.stage))

    def configurations(self, pipeline: Grid) -> int:
        """Return the number of its configurations: one for a scene's variable."""
        return math.prod(len(axis) for axis in self.configuration_axes(pipeline))

    def dimensions(self, pipeline: Grid) -> tuple[str, ...]:
        """Return the names of its dimensions: its axes, then ``inner``."""
        return tuple(axis.name for axis in self.axes(pipeline)) + self.inner

    def shape(self, pipeline: Grid) -> tuple[int, ...]:
        """Return the lengths of its dimensions."""
        return tuple(len(axis) for axis in self.axes(pipeline)) + self.inner_shape

    def attributes(self) -> dict[str, Any]:
        """Return its attributes, after the CF conventions."""
        return cf_attributes(self.meaning, self.units, self.flags)


# --------------------------------------------------------------------------------------------------
# The schema of the dataset: one record a variable, from which everything else about it follows.
#
# The evaluation fills it, the store is laid out by it, verification checks flags and tolerances
# by it, analysis and report read by it.

_S, _D, _E = Stage.scene, Stage.detection, Stage.estimation
_TRUTH = FlagRule("detection", "unless_lost")
_BOUND, _MAYBE_BOUND = FlagRule("bound", "always"), FlagRule("bound", "only")
_POSE, _MAYBE_POSE = FlagRule("estimate", "always"), FlagRule("estimate", "only")
_EQUAL = Tolerance("equal")
_ANGLE = Tolerance("absolute", math.degrees(ROTATION_ATOL_RAD))

#: Every variable, in the order in which the stages make them.
SCHEMA: tuple[Variable, ...] = (
    Variable("true_rvec", _S, "f8", "true rotation vector, marker to camera", "radian", ("xyz",),
             present_when=_TRUTH, tolerance=Tolerance("length", TRUTH_RTOL)),
    Variable("true_tvec_m", _S, "f8", "true position of the marker's centre", "m", ("xyz",),
             present_when=_TRUTH, tolerance=Tolerance("length", TRUTH_RTOL)),
    Variable("marker_area_px", _S, "f8", "area of the projected black square", "px2",
             present_when=FlagRule("detection", "if_seen"),
             tolerance=Tolerance("relative", TRUTH_RTOL)),
    Variable("viewing_angle_deg", _S, "f8",
             "angle between the marker's normal and the line of sight to its centre", "degree",
             present_when=_TRUTH, tolerance=Tolerance("absolute", 180 * TRUTH_RTOL)),
    Variable("bound", _S, "u1", "what became of the accuracy bound", flags=flags.BoundStatus,
             tolerance=_EQUAL),
    Variable("bound_std", _S, "f4",
             "least standard deviation of an unbiased estimate, camera frame (Cramér-Rao)",
             "radian, m", ("pose_parameter",),
             present_when=_BOUND, tolerance=Tolerance("relative", BOUND_RTOL)),
    Variable("bound_kappa", _S, "f4",
             "bias of the depth from the bound's own spread of the tilt, in standard deviations",
             present_when=_BOUND, tolerance=Tolerance("relative", BOUND_RTOL)),
    Variable("mirror_distance", _S, "f4",
             "standard deviations between the pose and its mirrored minimum; NaN: there is none",
             present_when=_MAYBE_BOUND, tolerance=Tolerance("relative", BOUND_RTOL)),
    Variable("detection", _D, "u1", "what became of the marker", flags=DetectionStatus,
             tolerance=_EQUAL),
    Variable("corner_error_px", _D, "f4", "found corner minus true corner", "px",
             ("corner", "xy"), present_when=FlagRule("detection", "always"),
             tolerance=Tolerance("absolute", CORNER_ATOL_PX)),
    Variable("estimate", _E, "u1", "what became of the pose", flags=flags.EstimateStatus,
             tolerance=_EQUAL),
    Variable("translation_error_m", _E, "f4", "estimated minus true, camera frame", "m",
             ("xyz",),
             present_when=_POSE, tolerance=Tolerance("distance", TRANSLATION_RTOL)),
    Variable("rotation_error_rad", _E, "f4",
             "rotation vector of estimated times true transposed, camera frame", "radian",
             ("xyz",),
             present_when=_POSE, tolerance=Tolerance("rotation", ROTATION_ATOL_RAD)),
    Variable("rotation_error_deg", _E, "f4", "angle of the rotation error", "degree",
             present_when=_POSE, tolerance=_ANGLE),
    Variable("normal_error_deg", _E, "f4", "angle between true and estimated normal", "degree",
             present_when=_POSE, tolerance=_ANGLE),
    Variable("reprojection_error_px", _E, "f4", "RMS over the corners", "px",
             present_when=_POSE, tolerance=Tolerance("absolute", CORNER_ATOL_PX)),
    Variable("alternative_rotation_error_deg", _E, "f4",
             "angle of the rotation error of the other planar solution", "degree",
             present_when=_MAYBE_POSE),
    Variable("alternative_reprojection_error_px", _E, "f4",
             "RMS over the corners of the other planar solution", "px",
             present_when=_MAYBE_POSE),
    Variable("predicted_std", _E, "f4",
             "standard deviation of the error that the estimator expects, camera frame",
             "radian, m", ("pose_parameter",), present_when=_MAYBE_POSE),
    Variable("nees", _E, "f4",
             "squared error in units of the expected covariance; its mean is 6 where that is true",
             present_when=_MAYBE_POSE),
    Variable("residual_variance_ratio", _E, "f4",
             "variance of the pixels' residuals over that of noise and rounding",
             present_when=_MAYBE_POSE),
    Variable("misfit_px", _E, "f4",
             "standard deviation of shifts of the marker's parts beside the fitted pose that the "
             "residuals of photometric_real show", "px", present_when=_MAYBE_POSE),
    Variable("flipped", _E, "u1", "whether the solution is nearer to the mirror of the truth",
             flags=flags.Flipped),
    Variable("ambiguous", _E, "u1", "whether another pose explains the pixels about as well",
             flags=flags.Ambiguous),
)

#: The variables that stores of boards have besides; those of :data:`NOT_OF_BOARDS` they lack.
BOARD_SCHEMA: tuple[Variable, ...] = (
    Variable("board_marker_id", _S, "f4", "ID of each marker of the board, in the board's order",
             inner=("marker",)),
    Variable("marker_detection", _D, "u1", "what became of each marker of the board",
             inner=("marker",), flags=DetectionStatus, tolerance=_EQUAL),
    Variable("marker_corner_error_px", _D, "f4", "found corner minus true corner, of each marker",
             "px", ("marker", "corner", "xy"), present_when=FlagRule("marker_detection", "always"),
             tolerance=Tolerance("absolute", CORNER_ATOL_PX)),
    Variable("chessboard_corner_error_px", _D, "f4",
             "interpolated corner of the chessboard minus true corner; NaN: not found", "px",
             ("chessboard_corner", "xy"), present_when=FlagRule("detection", "only"),
             tolerance=Tolerance("absolute", CORNER_ATOL_PX)),
    Variable("point_count", _E, "f4", "points that the pose was estimated from",
             present_when=_POSE),
)

NOT_OF_BOARDS = frozenset({"corner_error_px"})

#: Every variable by its name, boards' included.
VARIABLES = {each.name: each for each in (*SCHEMA, *BOARD_SCHEMA)}


# --------------------------------------------------------------------------------------------------
# Variables that not every pipeline has: draws, and the record of photographs.

def _drawn(name: str, meaning: str, unit: str, scale: float = 0.0, drawn_as: str = "") -> Variable:
    """Return the variable of a number of each scene that is drawn, or follows from one that is.

    ``scale`` is the largest number that it is added up from, by which rounding is measured; 0 if
    it is a product.
    """
    tolerance = Tolerance("absolute", TRUTH_RTOL * scale) if scale else Tolerance(
        "relative", TRUTH_RTOL)
    return Variable(name, Stage.scene, "f8", meaning, unit, present_when=_TRUTH,
                    tolerance=tolerance, drawn_as=drawn_as or name)


#: The variables that stores of photographs have besides.
PHOTOGRAPH_SCHEMA: tuple[Variable, ...] = (
    _drawn("side_px", "side of the black square if it were parallel to the image plane", "px"),
    _drawn("distance_m", "depth of the marker's centre along the optical axis", "m"),
    _drawn("tilt_deg", "angle between the marker's plane and the image plane", "degree", 180),
    _drawn("image_x_px", "image of the marker's centre, x", "px", 1e6),
    _drawn("image_y_px", "image of the marker's centre, y", "px", 1e6),
    Variable("truth", _S, "u1", "origin of the true pose", flags=flags.TruthSource,
             tolerance=_EQUAL),
    Variable("truth_std", _S, "f4",
             "standard deviation of the true pose, as far as it is known; camera frame",
             "radian, m", ("pose_parameter",),
             tolerance=Tolerance("relative", 1e-6)),
)


def drawn_variables(pipeline: Grid) -> tuple[Variable, ...]:
    """Return the variables that hold each scene's drawn values, except the noise of pixels.

    Examples
    --------
    >>> from sweep.experiment.pipeline import Pipeline
    >>> pipeline = Pipeline.from_dict({"pose": {"side_px": {"uniform": [20, 40]}}})
    >>> [variable.name for variable in drawn_variables(pipeline)]
    ['side_px', 'distance_m']
    """
    scales = {name: drawn.largest for name, drawn in pipeline.distributions.items()}
    if "side_px" in scales:
        scales["distance_m"] = 0.0
    variables = [
        _drawn(name, pipeline.parameters[name].meaning, pipeline.parameters[name].unit, scale)
        for name, scale in scales.items()]
    if jitter := max(map(float, pipeline.values_of("jitter_px")), default=0.0):
        variables += [_drawn(f"jitter_{axis}_px", "shift of the centre's undistorted projection "
                             f"along {axis}", "px", jitter, f"shift_{axis}_px") for axis in "uv"]
    if (error := pipeline.calibration) is not None:
        variables += [
            _drawn(f"believed_{name}", f"{name.removesuffix('_px')} as a calibration gives it, "
                   "for estimators that believe it", unit, scale + MAX_DEVIATIONS * error.sd(name),
                   CALIBRATED + name)
            for name in error.names
            for unit, scale in [("px", CALIBRATION_SCALE_PX) if name in VIEW else ("", 1.0)]]
    return tuple(variables)


def variables_of(pipeline: Grid) -> tuple[Variable, ...]:
    """Return the variables that a pipeline's store has: the schema's, then draws.

    Those of each marker of a board are as long as the largest board.

    >>> from sweep.experiment.pipeline import Pipeline
    >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 1, "jitter_px": 0.5}})
    >>> [variable.name for variable in variables_of(pipeline)[-2:]]
    ['jitter_u_px', 'jitter_v_px']
    """
    common = SCHEMA
    if pipeline.shows_boards:
        markers, corners = pipeline.largest_board
        lengths = (("marker", markers), ("chessboard_corner", corners))
        common = tuple(each for each in SCHEMA if each.name not in NOT_OF_BOARDS) + tuple(
            dataclasses.replace(variable, lengths=lengths) for variable in BOARD_SCHEMA
            if corners or "chessboard_corner" not in variable.inner)
    photographed = PHOTOGRAPH_SCHEMA if "photographs" in pipeline.given else ()
    return common + drawn_variables(pipeline) + photographed
