"""Random draws: a function of (seed, quantity, geometry key, trial); Sobol' points."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.grid import Distribution
from sweep.experiment.parameters import GEOMETRY_SECTIONS, PARAMETERS, WORLD
from sweep.model import camera, pose
from sweep.model.board import along_sides
from sweep.model.calibration import CalibrationError
from sweep.model.camera import VIEW_PARAMETERS, Column, canonical_distortion, intrinsics
from sweep.model.coverage import mixed
from sweep.model.marker import marker_corners, module_count, overhang
from sweep.model.scene import build_cameras
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Sobol' points, scrambled: draws of several quantities that fill their space evenly.
#
# SciPy's points are those of Sobol' (USSR Computational Mathematics and Mathematical Physics 7(4),
# 1967) with the direction numbers of Joe and Kuo ("Constructing Sobol sequences with better two-
# dimensional projections", SIAM Journal on Scientific Computing 30(5), 2008), in the order of
# Antonov and Saleev's Gray code. They are randomised by Owen's nested uniform scrambling ("Randomly
# permuted (t,m,s)-nets and (t,s)-sequences", 1995): each binary digit is flipped by a random bit
# that depends on the digits before it. So each point is uniform, and replicates with scrambles of
# their own are independent.

#: Independent randomisations; the trial modulo this is the number of a trial's replicate.
REPLICATES = 16

#: Binary digits of a point; those beyond are random.
BITS = 32

_STEP = np.uint64(0x9E3779B97F4A7C15)
_ONE = np.uint64(1)


@lru_cache(maxsize=64)
def _directions(dimension: int, count: int) -> NDArray[np.uint64]:
    """Return the first direction numbers (count,) of a dimension, times 2^32."""
    from scipy.stats import qmc  # noqa: PLC0415  (slow to import, for few pipelines)

    engine = qmc.Sobol(dimension + 1, scramble=False, bits=BITS)
    corners = [engine.reset().fast_forward(1 << k).random()[0, dimension] for k in range(count)]
    # Point 2^k is the sum of the directions k and k - 1, which its Gray code has.
    return np.bitwise_xor.accumulate((np.array(corners) * 2.0**BITS).astype(np.uint64))


def points(dimension: int, index: Integers) -> NDArray[np.uint64]:
    """Return the points (N,) of a dimension at indices (N,) of the sequence, times 2^32.

    A point is the sum modulo 2 of the directions that the Gray code of its index has, wherever it
    is in the sequence.
    """
    index = np.asarray(index, dtype=np.uint64)
    gray, result = index ^ (index >> _ONE), np.zeros(index.shape, dtype=np.uint64)
    for direction in _directions(dimension, int(index.max(initial=0)).bit_length()):
        result ^= direction * (gray & _ONE)
        gray >>= _ONE
    return result


def scrambled(digits: NDArray[np.uint64], keys: NDArray[np.uint64]) -> Floats:
    """Return points (N,) of :data:`BITS` digits, scrambled by keys (N,), as numbers in (0, 1).

    A digit is flipped by a random bit of the key and the digits before it; those beyond the last
    are random bits of the key and all digits. 53 in all, in the middle of their interval.
    """
    result = np.zeros(digits.shape, dtype=np.uint64)
    for k in range(BITS):
        # The digits before it, and their number, so that prefixes of any length differ.
        prefix = (digits >> np.uint64(BITS - k)) | np.uint64((k + 1) << BITS)
        flip = mixed(keys ^ mixed(prefix)) >> np.uint64(63)
        digit = (digits >> np.uint64(BITS - 1 - k)) & _ONE
        result = (result << _ONE) | (digit ^ flip)
    rest = mixed(keys ^ mixed(digits | np.uint64((BITS + 1) << BITS)))
    result = (result << np.uint64(53 - BITS)) | (rest >> np.uint64(64 - (53 - BITS)))
    return np.asarray((result + 0.5) * 2.0**-53)


def sobol_uniform(dimension: int, keys: NDArray[np.uint64], trials: Integers) -> Floats:
    """Return uniform numbers in (0, 1) of scenes, (N,), evenly spread over the trials.

    Parameters
    ----------
    dimension
        Number of the quantity among those that are drawn.
    keys
        (N,) random bits of the seed, the quantity and the scene's geometry, not of its trial.
    trials
        (N,) trial ``t`` is point ``t // 16`` of replicate ``t % 16``, whatever other trials exist.
    """
    index, replicate = np.divmod(np.asarray(trials, dtype=np.uint64), np.uint64(REPLICATES))
    own = mixed(keys + _STEP * (replicate + _ONE))
    return scrambled(points(dimension, index), own)


# --------------------------------------------------------------------------------------------------
# The pose in the ways that users give it, resolved to the one that scenes are made from.
#
# A scene's pose is tilt, azimuth, roll, ``distance_m``, and bearings or ``x_m``, ``y_m``. The
# other parameters of a pose are turned into these, step by step; a step whose parameters are not
# given does nothing.

Columns = dict[str, Column]

ANGLES = ("tilt_deg", "azimuth_deg", "roll_deg")
BEARINGS = ("bearing_x_deg", "bearing_y_deg")
CENTRE = ("x_m", "y_m")
SHARES = ("frame_x", "frame_y")
SHIFTS = ("shift_u_px", "shift_v_px")

#: The parameters that :func:`distance_of_side` needs.
DISTANCE_PARAMETERS = (*VIEW_PARAMETERS, "size_m", "side_px")

#: Decimals of degrees to which resolved angles enter the geometry key: they have rounding errors
#: where angles that are given have none.
KEY_DECIMALS = 10


def distance_of_side(values: Mapping[str, Any]) -> Any:
    """Return the distance in m at which the black square's side is ``side_px`` long.

    ``fx · size / side``; ``values`` has numbers or arrays for :data:`DISTANCE_PARAMETERS`.
    """
    fx = intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0]
    return fx * values["size_m"] / values["side_px"]


def _view(values: Mapping[str, Column]) -> tuple[Any, Any, Any, Any]:
    """Return fx, fy, cx, cy in pixels of scenes: numbers, or arrays (n,)."""
    return intrinsics(*(values[name].values for name in VIEW_PARAMETERS))


def resolve_pose(values: Columns) -> None:
    """Add the parameters that scenes are made from to values, of which none is to be drawn yet.

    The angles have names of their own: ``roll_deg`` of yaw, pitch and roll stays as it is given.
    """
    pose = dict(values)
    for step in STEPS:
        if step.is_given(pose):
            pose.update(step.take(pose))
    values.update({name: pose[name] for name in ("distance_m", *CENTRE)})
    values.update({f"resolved_{name}": pose[name] for name in ANGLES})


def canonical_pose(values: Mapping[str, Column], drawn: Collection[str]) -> Columns:
    """Return the values with a pose that is the same in whichever way it is given.

    These are tilt, azimuth, roll, distance and bearings, without jitter. What follows from values
    that are ``drawn`` stays as it is given.
    """
    canonical: Columns = {**values, **dict.fromkeys(SHIFTS, Column.of(0.0))}
    unknown = set(drawn)
    for step in (*STEPS, _TO_BEARINGS):
        given = step.is_given(canonical)
        if unknown.intersection(step.given) or (given and unknown.intersection(step.others)):
            unknown.update(step.makes)
        elif given:
            made = step.take(canonical)
            canonical |= dict.fromkeys(step.given, Column.of(None))
            canonical |= {name: Column(np.round(column.values, KEY_DECIMALS) + 0.0, column.constant)
                          if name.endswith("_deg") else column for name, column in made.items()}
    return canonical


@dataclass(frozen=True, slots=True)
class Step:
    """The resolution of one way in which a part of the pose is given.

    Attributes
    ----------
    given
        The parameters of this way: the step is taken if one of them is given.
    others
        Parameters that it reads beside them.
    makes
        Parameters that it resolves.
    resolve
        Returns the values (n,) of ``makes`` for n scenes.
    """

    given: tuple[str, ...]
    others: tuple[str, ...]
    makes: tuple[str, ...]
    resolve: Callable[[Mapping[str, Column], int], tuple[Floats, ...]]

    def is_given(self, values: Mapping[str, Column]) -> bool:
        """Return whether one of the parameters has a value."""
        return any(name in values and not values[name].missing for name in self.given)

    def take(self, values: Mapping[str, Column]) -> Columns:
        """Return the columns that it makes: of one value where all scenes share what it reads."""
        read = [values[name] for name in (*self.given, *self.others) if name in values]
        each = [len(column.values) for column in read if not column.constant]
        made = self.resolve(values, each[0] if each else 1)
        return {name: Column.of(array if each else float(array[0]))
                for name, array in zip(self.makes, made, strict=True)}


def _numbers(
    values: Mapping[str, Column], names: Collection[str], count: int, missing: float = 0.0
) -> list[Floats]:
    """Return parameters as arrays (count,); ``missing`` stands for one that is not given."""
    return [np.full(count, missing) if values.get(name, Column.of(None)).missing
            else values[name].broadcast(count) for name in names]


def _from_side(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    distance = distance_of_side({name: values[name].values for name in DISTANCE_PARAMETERS})
    return (Column.of(distance).broadcast(count),)


def _from_world(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    """Resolve the places of camera and marker in the world."""
    numbers = dict(zip(WORLD, _numbers(values, WORLD, count), strict=True))
    located = []
    for whose in ("camera", "marker"):
        angles = (np.radians(numbers[f"{whose}_{name}_deg"]) for name in ("yaw", "pitch", "roll"))
        origin = np.stack([numbers[f"{whose}_{axis}_m"] for axis in "xyz"], axis=1)
        located += [origin, pose.orientation(*angles)]
    rotation, position = pose.pose_in_camera(*located)
    return (*_angles(rotation), *position.T)


def _from_yaw_and_pitch(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    angles = _numbers(values, ("yaw_deg", "pitch_deg", "roll_deg"), count)
    return _angles(pose.rotation_of_yaw_pitch_roll(*map(np.radians, angles)))


def _angles(rotation: Floats) -> tuple[Floats, ...]:
    return tuple(np.degrees(angle) for angle in pose.angles_of_rotation(rotation))


def _from_view_angle(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    """Resolve the angle to the line of sight, which jitter moves, too."""
    depth = values["distance_m"].broadcast(count)
    centre_xy = _centres(values, count) + _shifts(values, count)
    return _angles(_facing(values, count)(np.arange(count), np.column_stack([centre_xy, depth])))


def _facing(
    values: Mapping[str, Column], count: int
) -> Callable[[NDArray[np.intp], Floats], Floats]:
    """Return the function of rows (n,) and positions (n, 3) that returns the rotations there."""
    tilt, azimuth, roll = map(np.radians, _numbers(values, ANGLES, count))
    if values["view_angle_deg"].missing:
        rotation = pose.rotation_of_angles(tilt, azimuth, roll)
        return lambda rows, _: rotation[rows]
    view = np.radians(values["view_angle_deg"].broadcast(count))
    # After the smallest rotation of the optical axis to the line of sight, the angle between this
    # and the marker's normal is the view angle wherever the marker is.
    return lambda rows, position: np.asarray(
        pose.towards(position) @ pose.rotation_of_angles(view[rows], azimuth[rows], roll[rows])
    )


def _centres(values: Mapping[str, Column], count: int) -> Floats:
    """Return the centre's x and y (count, 2) in metres, without jitter."""
    depth = values["distance_m"].broadcast(count)
    return np.stack([
        depth * np.tan(np.radians(values[bearing].broadcast(count)))
        if values[metres].missing else values[metres].broadcast(count)
        for metres, bearing in zip(CENTRE, BEARINGS, strict=True)], axis=1)


def _shifts(values: Mapping[str, Column], count: int, names: Sequence[str] = SHIFTS) -> Floats:
    """Return the jitter in metres at the centre's depth, along x and y, (count, 2)."""
    depth, pixels = values["distance_m"].broadcast(count), _numbers(values, names, count)
    return np.stack([depth * (pixel / length)
                     for pixel, length in zip(pixels, _view(values)[:2], strict=True)], axis=1)


def _from_frame(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    """Resolve the place between those at which the marker touches the frame."""
    cameras = build_cameras(values, count)
    modules = values["dictionary"].map(module_count).broadcast(count)
    size, quiet = _numbers(values, ("size_m", "quiet_zone_modules"), count)
    margin = quiet + values["dictionary"].map(overhang).broadcast(count)
    outline = marker_corners(size * (1 + 2 * margin / modules))
    depth = values["distance_m"].broadcast(count)
    facing, given = _facing(values, count), _centres(values, count)
    shift = _shifts(values, count)
    margin = _shifts(values, count, ("jitter_px", "jitter_px"))
    frame = np.stack(_numbers(values, ("width_px", "height_px"), count), axis=1)
    share = np.stack(_numbers(values, SHARES, count, np.nan), axis=1)
    centres = np.empty((count, 2))

    def offsets(
        rows: NDArray[np.intp], points: Floats, part: NDArray[np.intp], centre_xy: Floats
    ) -> Floats:
        position = np.column_stack([centre_xy, depth[rows[part]]])
        return pose.transform_points(
            points[part], facing(rows[part], position), np.zeros_like(position))

    # A scene's values must not depend on whether others have a lens.
    for curved in (False, True):
        rows = np.flatnonzero(cameras.distorted == curved)
        points = along_sides(outline[rows], camera.PER_SIDE if curved else 1)
        centres[rows] = camera.Framing(
            cameras.take(rows), frame[rows], depth[rows], partial(offsets, rows, points),
            share[rows], given[rows], margin[rows], shift[rows],
        ).centres()
    return tuple(centres.T)


def _bearings(values: Mapping[str, Column], count: int) -> tuple[Floats, ...]:
    depth, centres = values["distance_m"].broadcast(count), _centres(values, count)
    return tuple(np.degrees(np.arctan2(across, depth)) for across in centres.T)


_POSITION = ("distance_m", *CENTRE, *BEARINGS, *SHIFTS, *VIEW_PARAMETERS)

#: Every step, each after those that make what it reads.
STEPS = (
    Step(("side_px",), (*VIEW_PARAMETERS, "size_m"), ("distance_m",), _from_side),
    Step(WORLD, (), (*ANGLES, *CENTRE, "distance_m"), _from_world),
    Step(("yaw_deg", "pitch_deg"), ("roll_deg",), ANGLES, _from_yaw_and_pitch),
    Step(SHARES, (*_POSITION, *ANGLES, "view_angle_deg", "distortion", "jitter_px", "size_m",
                  "quiet_zone_modules", "dictionary"), CENTRE, _from_frame),
    Step(("view_angle_deg",), ("azimuth_deg", "roll_deg", *_POSITION), ANGLES, _from_view_angle),
)

_TO_BEARINGS = Step(CENTRE, ("distance_m", *BEARINGS), BEARINGS, _bearings)


# --------------------------------------------------------------------------------------------------
# Random draws: a function of (seed, quantity, geometry key, trial), and of nothing else.
#
# The geometry key of a cell is the text of its own camera, marker and pose values: canonical (a
# camera in mm as one in pixels, the pose in whichever way it is given as tilt, azimuth, roll,
# distance and bearings, unless these depend on a draw), sorted by name, defaults left out,
# numbers rounded to 12 significant digits. Whether a value is fixed or an axis, in which order
# and on which grid, does not matter; nor do renderer, window, levels, detector or estimator.

_DEFAULT_FOCAL_PX = intrinsics(*(PARAMETERS[name].default for name in VIEW_PARAMETERS))[:2]
_PLAIN = (
    "width_px", "height_px",
    *(p.name for p in PARAMETERS.values()
      if p.section in GEOMETRY_SECTIONS and p.section != "camera" and p.name != "side_px"),
)


def _text(value: Any) -> str:
    """Return the canonical text of a value."""
    if isinstance(value, tuple):
        return ",".join("" if item is None else _text(item) for item in value)
    return value.upper() if isinstance(value, str) else f"{float(value) + 0.0:.12g}"


def key_texts(name: str, column: Column, default: Any) -> Column:
    """Return "name=value" of each value, empty where it is the default, or there is none."""
    left_out = None if default is None else _text(default)

    @cache
    def labelled(value: Any) -> str:
        text = left_out if value is None else _text(value)
        return "" if text == left_out else f"{name}={text}"

    return column.map(labelled)


def geometry_keys(
    values: Mapping[str, Column], distributions: Mapping[str, Distribution], count: int
) -> NDArray[np.uint64]:
    """Return the hashed geometry keys (count,) of scenes.

    ``values`` has every parameter of camera, marker and pose that is not drawn.
    """
    values = canonical_pose(values, distributions)
    fx, fy, cx, cy = map(Column.of, _view(values))
    columns = {
        "fx_px": key_texts("fx_px", fx, _DEFAULT_FOCAL_PX[0]),
        "fy_px": key_texts("fy_px", fy, _DEFAULT_FOCAL_PX[1]),
        "distortion": key_texts("distortion", values["distortion"].map(canonical_distortion), ()),
    }
    for name, centre, length in (("cx_px", cx, "width_px"), ("cy_px", cy, "height_px")):
        if not values[name].missing:
            middle = Column.of((values[length].values - 1) / 2)
            columns[name] = camera.map_columns(
                lambda text, default: "" if text == default else text,
                [key_texts(name, centre, None), key_texts(name, middle, None)])
    columns |= {
        name: key_texts(name, values[name], PARAMETERS[name].default) for name in _PLAIN
        if name not in distributions and name in values and not values[name].missing}
    columns |= {name: Column.of(f"{name}={distribution}")
                for name, distribution in distributions.items()
                if name in PARAMETERS and PARAMETERS[name].section in GEOMETRY_SECTIONS}
    return hashed([columns[name] for name in sorted(columns)], count)


def hashed(texts: Sequence[Column], count: int) -> NDArray[np.uint64]:
    """Return a hash (count,) of the texts of each of ``count`` scenes; empty ones do not count."""
    used = [column for column in texts if column.differs_from("")]
    joined = camera.map_columns(lambda *each: "|".join(filter(None, each)), used or [Column.of("")])
    return joined.map(_hash).broadcast(count, np.uint64)


@lru_cache(maxsize=1 << 14)
def _hash(text: str) -> np.uint64:
    """Return 64 bits of a text's BLAKE2b hash."""
    return np.uint64(int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little"))


#: How the draws of a cell's trials relate: not at all, or so that they fill their space evenly.
SAMPLINGS = ("independent", "sobol")


def uniform(
    seed: int, quantity: str, keys: NDArray[np.uint64], trials: Integers,
    dimension: int | None = None,
) -> Floats:
    """Return uniform numbers in (0, 1) of scenes, by geometry key and trial, (N,) each.

    (seed, quantity) is hashed by BLAKE2b, as the keys are; trials are steps of SplitMix64 from
    there. 53 bits, in the middle of their interval, so that neither 0 nor 1 occurs. With the number
    of the quantity among those that are drawn together, its ``dimension``, they fill the space of
    these evenly.
    """
    if dimension is not None:
        start = mixed(keys ^ _hash(f"{seed}\nsobol\n{quantity}"))
        return sobol_uniform(dimension, start, trials)
    return np.asarray(((bits(seed, quantity, keys, trials) >> np.uint64(11)) + 0.5) * 2.0**-53)


def bits(
    seed: int, quantity: str, keys: NDArray[np.uint64], trials: Integers
) -> NDArray[np.uint64]:
    """Return 64 random bits for each scene (arguments as :func:`uniform`)."""
    start = mixed(keys ^ _hash(f"{seed}\n{quantity}"))
    return np.asarray(mixed(start + _STEP * (np.asarray(trials).astype(np.uint64) + _ONE)))


# --------------------------------------------------------------------------------------------------
# Draws of a calibration: the camera's numbers as an estimator believes them.

#: Begins the names of numbers that a calibration gives, among a scene's values.
CALIBRATED = "calibrated_"

NORMAL = Distribution("normal", 0.0, 1.0)


def calibrated_columns(
    error: CalibrationError, values: Mapping[str, Column], count: int,
    draw: Callable[[str], Floats],
) -> dict[str, Column]:
    """Return the numbers that a calibration gives of each scene's camera.

    Parameters
    ----------
    error
        The calibration's error.
    values
        The values of ``count`` scenes.
    draw
        Name of a quantity -> uniform numbers (count,) in (0, 1).
    """
    truth = [Column.of(number).broadcast(count) for number in _view(values)]
    lenses = np.zeros((count, len(error.names) - len(truth)))
    for row, lens in enumerate(values["distortion"].listed(count) if lenses.size else ()):
        lenses[row, : len(lens)] = lens
    normals = [NORMAL.at(draw(CALIBRATED + name)) for name in error.names]
    numbers = error.believed([*truth, *lenses.T], normals)
    return {CALIBRATED + name: Column.of(number)
            for name, number in zip(error.names, numbers, strict=True)}
