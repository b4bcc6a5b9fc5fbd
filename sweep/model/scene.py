"""Scenes: cameras, targets, poses and effects put together."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sweep.declaration import drawn, parameter
from sweep.model import board, effects
from sweep.model import lens as lens_model
from sweep.model.board import Board, extent_of
from sweep.model.camera import VIEW_PARAMETERS, Camera, Cameras, Column, intrinsics, map_columns
from sweep.model.effects import CODED, NEUTRAL, NO_PLUGINS, Effect, Patch, ScenePlugins
from sweep.model.marker import marker_corners, overhang
from sweep.model.polygon import Projection
from sweep.model.pose import rotation_of_angles, transform_points
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The names of the built-in renderers.

SUPERSAMPLE = re.compile(r"supersample-([1-9][0-9]{0,2})(-jittered)?")

#: The names in words.
RENDERERS = "exact, warp, supersample-N or supersample-N-jittered with N from 1 to 999"


def is_renderer(name: str) -> bool:
    """Return whether a built-in renderer has the name."""
    return name in ("exact", "warp") or SUPERSAMPLE.fullmatch(name) is not None


def renderer_name(value: Any) -> str:
    """Return the name of a built-in renderer as it is declared; ValueError if there is none."""
    name = value.strip().lower() if isinstance(value, str) else ""
    if not is_renderer(name):
        raise ValueError(RENDERERS)
    return name


# --------------------------------------------------------------------------------------------------
# Scenes: cameras, markers, poses and effects put together.

Key = TypeVar("Key")
#: Left, top, right, bottom in pixels of the frame; half-open.
Box = tuple[int, int, int, int]

@dataclass(frozen=True, slots=True)
class Scene:
    """The marker's surroundings, and the renderer."""

    renderer: str = parameter(
        "exact", "exact: area coverage; warp: the paper's, 10 px a module, INTER_LINEAR; "
        "supersample-N: N x N regular samples a pixel; supersample-N-jittered: at random within "
        "their cells; or a plug-in: the name of an installed one, or file:name beside the pipeline",
        plugin="renderer", reads=renderer_name,
    )
    window: str = parameter(
        "auto", "auto: render and search the pixels that the marker can influence; full: the whole "
        "frame", choices=("auto", "full"),
    )
    black: float = drawn(0.0, "level of black", 0, 255, unit="grey level")
    white: float = drawn(255.0, "level of white", 0, 255, unit="grey level")
    background: float | str = drawn(
        0.0, "level beside the marker, or an image file of exactly the frame's size (path relative "
        "to the pipeline file)", 0, 255, unit="grey level",
    )
    photographs: str | None = parameter(
        None, "photographs with the poses of their markers, in place of simulated images: a file "
        "that `sweep photos` writes (path relative to the pipeline file); trial is then the "
        "photograph's number",
    )
    simulated: bool = parameter(
        False, "true: of the photographs the poses alone are taken, and each marker is simulated "
        "by itself; trial k has the poses of photograph k modulo their number",
    )


@dataclass(frozen=True, slots=True)
class Targets:
    """The targets of N scenes: the distinct ones, and (N,) the number of each scene's."""

    boards: tuple[Board, ...]
    number: NDArray[np.int64]

    @staticmethod
    def of(each: Sequence[Board]) -> Targets:
        """Return the targets that N scenes show, one of each."""
        return Targets(*distinct(each))

    def __len__(self) -> int:
        return len(self.number)

    def __getitem__(self, row: int) -> Board:
        return self.boards[int(self.number[row])]

    def __iter__(self) -> Iterator[Board]:
        return (self.boards[number] for number in self.number.tolist())

    @property
    def are_markers(self) -> bool:
        """Whether each target is a marker alone."""
        return all(self.boards[number].is_marker for number in set(self.number.tolist()))

    def take(self, rows: NDArray[np.intp]) -> Targets:
        """Return the targets of the given rows."""
        return Targets(self.boards, self.number[rows])

    def each(self, read: Callable[[Board], Any]) -> NDArray[Any]:
        """Return (N, ...) a property of each scene's target."""
        return np.array([read(target) for target in self.boards])[self.number]


Returned = TypeVar("Returned")


def kept_for_row(function: Callable[[Any, int], Returned]) -> Callable[[Any, int], Returned]:
    """Make a function of scenes and a row keep what it returned for the row that was asked last."""

    @functools.wraps(function)
    def kept(scenes: Any, row: int) -> Returned:
        last, returned = scenes.memo.get(function, (-1, None))
        if last != row:
            returned = function(scenes, row)
            scenes.memo[function] = row, returned
        return cast("Returned", returned)

    return kept


@dataclass(frozen=True, slots=True)
class SceneEffects:
    """The effects of N scenes: exposure, sensor and light.

    Attributes
    ----------
    values
        (N,) each: every parameter of the effects, NaN if not given.
    coded
        Parameter of an effect that is text or a list -> the values that the numbers in ``values``
        stand for.
    present, active
        The effects that a scene may have, and (N,) whether one is active.
    noise_key
        (N,) keys of the noise.
    plugins
        All effects, and the plug-ins' renderers, whose settings are among the values.
    memo
        What :func:`kept_for_row` keeps.
    """

    values: Mapping[str, Floats]
    coded: Mapping[str, Sequence[Any]]
    present: Sequence[Effect]
    active: NDArray[np.bool_]
    noise_key: NDArray[np.uint64]
    plugins: ScenePlugins
    memo: dict[Any, tuple[int, Any]] = field(default_factory=dict, init=False)

    def __getitem__(self, name: str) -> Floats:
        return self.values[name]

    def outlines(self, change: str) -> NDArray[np.bool_]:
        """Return whether an effect is active whose record has ``outline = change``, (N,)."""
        return self.any_active(lambda effect: effect.outline == change)

    @kept_for_row
    def of(self, row: int) -> dict[str, Any]:
        """Return the parameters of one scene: numbers, NaN if not given, texts and lists."""
        numbers = {name: float(column[row]) for name, column in self.values.items()}
        return numbers | {name: each[int(numbers[name])] for name, each in self.coded.items()}

    def active_in(self, row: int) -> list[Effect]:
        """Return the effects that are active in one scene."""
        return [
            each for each in self.present if each.is_active(self.values[each.switch][row])
        ]

    @property
    def noise_coarseness(self) -> NDArray[np.int64]:
        """0 for scenes without noise of pixels, 1 with it, 2 with coarse noise, (N,)."""
        noisy = self.any_active(lambda effect: effect.widens == "noise")
        coarse = self.any_active(lambda effect: "noise" in effect.worsens)
        return noisy * (1 + coarse.astype(np.int64))

    @property
    def uneven_gain(self) -> Floats:
        """Amplification of uneven light in each scene, at least 1; 0 if the light is even.

        Infinite beside an effect that makes it steeper.
        """
        uneven = self.any_active(lambda effect: effect.widens == "uneven light")
        steep = self.any_active(lambda effect: "uneven light" in effect.worsens)
        return np.where(uneven, np.where(steep, np.inf, np.maximum(self.values["gain"], 1.0)), 0.0)

    def any_active(self, concerned: Callable[[Effect], bool]) -> NDArray[np.bool_]:
        """Return whether one of the effects that are concerned is active, (N,)."""
        active = np.zeros(len(self.active), dtype=bool)
        for effect in filter(concerned, self.present):
            active |= effect.is_active(self.values[effect.switch])
        return active


class Motion(NamedTuple):
    """A target's motion in the camera frame, and when the rows of the frame are exposed.

    At rest the velocity is 0, and all rows are exposed at time 0.

    Attributes
    ----------
    translation
        (3,) position of its origin at time 0, in metres.
    velocity
        (6,) linear in m/s and angular in rad/s.
    exposure_s, row_time_s
        Duration of each row's exposure, and time from one row's to the next's.
    middle_row
        The row whose exposure has its middle at time 0.
    """

    translation: Floats
    velocity: Floats
    exposure_s: float
    row_time_s: float
    middle_row: float

    @property
    def moves(self) -> bool:
        """Whether the target moves while its image is taken."""
        return bool(self.velocity.any())

    def exposed(self, top: int, bottom: int) -> tuple[float, float]:
        """Return when the exposure of rows [top, bottom) begins and ends."""
        return (
            self.row_time_s * (top - self.middle_row) - self.exposure_s / 2,
            self.row_time_s * (bottom - 1 - self.middle_row) + self.exposure_s / 2,
        )


@dataclass(frozen=True, slots=True)
class Scenes:
    """N scenes as arrays: cameras, targets and their poses, surroundings and effects.

    Attributes
    ----------
    cameras, frame
        The cameras, and (N, 2) width and height of their frames in pixels.
    targets
        The targets of the scenes, markers and boards.
    size_m
        (N,) side of the black square; of a board, of markers without a side of their own.
    rotation, translation
        (N, 3, 3) and (N, 3): the true pose, metres, camera frame.
    plane
        (N, 3, 3) takes module coordinates (column, row, 1) of the printed marker, or a board's, to
        the camera frame; of a bent one those of its tangent plane at the centre.
    corners_px, outline_px
        (N, 4, 2) images of the corners of the black square of ``size_m`` (of a board, of what is
        black) and of all that is printed, beside a board too, both flat; NaN at z <= 0. Of targets
        in several planes the corners are of a rectangle about the image.
    levels
        (N, 3) grey levels of the background (0 if it is an image), black and white.
    renderer, background
        One value for each scene.
    effects
        Motion, optics, light, sensor and processing.
    memo
        What :func:`kept_for_row` keeps.
    """

    cameras: Cameras
    frame: NDArray[np.int64]
    targets: Targets
    size_m: Floats
    rotation: Floats
    translation: Floats
    plane: Floats
    corners_px: Floats
    outline_px: Floats
    levels: Floats
    renderer: Sequence[str]
    background: Sequence[float | str]
    effects: SceneEffects
    memo: dict[Any, tuple[int, Any]] = field(default_factory=dict, init=False)

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def dictionary(self) -> list[str]:
        """The dictionary of each scene's markers."""
        return [target.dictionary for target in self.targets]

    @property
    def marker_id(self) -> NDArray[np.int64]:
        """The ID of each scene's first marker, (N,)."""
        return self.targets.each(lambda target: target.marker_ids[0])

    @property
    def solid(self) -> NDArray[np.bool_]:
        """Whether markers, or what is beside them, are in several planes, (N,)."""
        return ~self.targets.each(lambda target: target.is_flat)

    def plain(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return whether images of scenes ``rows`` (n,) are exact, without effects, on one level.

        And of one plane.
        """
        exact = np.array([
            self.renderer[row] == "exact" and not isinstance(self.background[row], str)
            for row in rows.tolist()
        ], dtype=bool)
        return np.asarray(exact & ~self.solid[rows] & ~self.effects.active[rows])

    def projection(self, row: int) -> Projection:
        """Return the camera and the marker's plane of one scene as compiled functions take them."""
        return Projection(self.plane[row], self.cameras.optics(row))

    def patch(self, row: int, left: int, top: int) -> Patch:
        """Return the patch of one scene for effects on levels; (left, top) is their first pixel."""
        own, (width, height) = self.effects, self.frame[row].tolist()
        return Patch(
            own.of(row), left, top, (width, height), self.cameras.view[row],
            own.noise_key[row],
        )

    @kept_for_row
    def motion(self, row: int) -> Motion:
        """Return how the target of one scene moves while its image is taken."""
        effect = self.effects.of(row)
        velocity = np.array([effect[name] for name in effects.VELOCITIES])
        velocity[3:] = np.radians(velocity[3:])
        exposure_s, row_time_s = effect["exposure_s"], effect["row_time_s"]
        if not velocity.any() or exposure_s == row_time_s == 0.0:
            velocity, exposure_s, row_time_s = np.zeros(6), 0.0, 0.0
        return Motion(
            self.translation[row], velocity, exposure_s, row_time_s, (self.frame[row, 1] - 1) / 2
        )


def _target(
    shown: Board | None, dictionary: str, marker_id: int, size_m: float, width: float,
    white: float, background: float | str, occlusion: float,
) -> Board:
    """Return the target of a scene: a board, or a marker alone with a quiet zone of a width.

    A quiet zone on a background of its own level is invisible, unless a sheet hides a part of it:
    it is not modelled.
    """
    if shown is not None:
        marker_id = shown.marker_ids[0]
        single = shown.is_single and not shown.is_marker
        if not single or board.side_m(shown, size_m) != size_m:
            return shown
    quiet = 0.0 if background == white and occlusion == 0 else float(width)
    return board.single_marker(dictionary, int(marker_id), overhang(dictionary) + quiet)


_DEFAULTS = NEUTRAL | {field.name: field.default for field in dataclasses.fields(Camera)}


def build_scenes(
    values: Mapping[str, Any], count: int, plugins: ScenePlugins = NO_PLUGINS
) -> Scenes:
    """Return ``count`` scenes from parameter values.

    ``values`` has every parameter of camera, marker and scene (``distortion`` canonical);
    ``distance_m``, and ``x_m``, ``y_m`` or, without these, the bearings; ``tilt_deg``,
    ``azimuth_deg``, ``roll_deg``, instead of which ``resolved_tilt_deg`` and so on count if they
    are there; and ``shift_u_px``, ``shift_v_px``: the drawn jitter. ``board`` is the board that a
    scene shows in place of a marker, or None; without it ``neighbourhood`` may be there, a marker
    as a target with what is printed around it, or None. Each is a :class:`Column`, or a value that
    :meth:`Column.of` takes. ``plugins`` are needed if the scenes are to be rendered.
    """
    values = {
        **_DEFAULTS, "noise_key": 0, "x_m": None, "y_m": None,
        "board": values.get("neighbourhood"), **values,
    }

    def column(name: str) -> Column:
        return Column.of(values[name])

    def numbers(name: str) -> Floats:
        return column(name).broadcast(count)

    def mapped(function: Callable[..., Any], *names: str) -> list[Any]:
        return map_columns(function, [column(name) for name in names]).listed(count)

    cameras = build_cameras(values, count)
    fx, fy = cameras.view[:, 0], cameras.view[:, 1]

    # Step 4: the pose.
    rotation = rotation_of_angles(
        *(np.radians(numbers(f"resolved_{name}" if f"resolved_{name}" in values else name))
          for name in ("tilt_deg", "azimuth_deg", "roll_deg"))
    )
    distance = numbers("distance_m")

    def across(metres: str, bearing: str, shift: Floats) -> Floats:
        if column(metres).missing:
            return distance * (np.tan(np.radians(numbers(bearing))) + shift)
        return numbers(metres) + distance * shift

    translation = np.stack(
        [
            across("x_m", "bearing_x_deg", numbers("shift_u_px") / fx),
            across("y_m", "bearing_y_deg", numbers("shift_v_px") / fy),
            distance,
        ],
        axis=1,
    )

    # Steps 2, 3, 5, 6: the corners, moved by the pose and projected.
    size = numbers("size_m")
    targets = Targets.of(mapped(
        _target, "board", "dictionary", "marker_id", "size_m", "quiet_zone_modules", "white",
        "background", "occlusion",
    ))
    modules = targets.each(lambda target: extent_of(target).modules)
    sheet = targets.each(lambda target: extent_of(target).sheet)
    side = size if targets.are_markers else np.array([
        board.side_m(*each) for each in zip(targets, size.tolist(), strict=True)
    ])
    printed = side * numbers("marker_scale")
    half, module = printed / 2, printed / modules
    on_board = targets.each(lambda target: not target.is_marker)
    half[on_board] = 0.0
    plane = np.empty((count, 3, 3))
    plane[:, :, 0] = rotation[:, :, 0] * module[:, None]
    plane[:, :, 1] = -rotation[:, :, 1] * module[:, None]
    plane[:, :, 2] = (
        translation - (rotation[:, :, 0] - rotation[:, :, 1]) * half[:, None]
    )
    square_m = marker_corners(size)
    around_m = marker_corners(printed * (1 + 2 * -sheet[:, 0] / modules))
    ink = targets.each(lambda target: extent_of(target).ink)[on_board]
    square_m[on_board] = board.box_corners(ink) * (side / modules)[on_board, None, None]
    around_m[on_board] = board.box_corners(sheet[on_board]) * module[on_board, None, None]
    corners_px, outline_px = (
        cameras.project(transform_points(points, rotation, translation))
        for points in (square_m, around_m)
    )
    solid = ~targets.each(lambda target: target.is_flat)
    for row in np.flatnonzero(solid).tolist():
        camera, scale = cameras.take(np.array([row])), float(printed[row] / side[row])
        corners_px[row], outline_px[row] = board.boxes_px(
            targets[row], camera, rotation[row], translation[row], scale
        )

    levels = np.stack(
        [
            np.array(mapped(lambda b: 0.0 if isinstance(b, str) else float(b), "background")),
            numbers("black"),
            numbers("white"),
        ],
        axis=1,
    )
    own = [name for each in plugins.effects for name in each.parameters if name not in CODED]
    strengths = {name: numbers(name) for name in (*own, *plugins.settings)}
    coded: dict[str, Sequence[Any]] = {}
    for name in CODED:
        coded[name], number = distinct([NEUTRAL[name], *column(name).listed(count)])
        strengths[name] = number[1:].astype(np.float64)
    present = [each for each in plugins.effects if column(each.switch).differs_from(each.off)]
    active = np.zeros(count, dtype=bool)
    for each in present:
        active |= each.is_active(strengths[each.switch])
    return Scenes(
        cameras=cameras,
        frame=np.stack([numbers("width_px"), numbers("height_px")], axis=1).astype(np.int64),
        targets=targets,
        size_m=size,
        rotation=rotation,
        translation=translation,
        plane=plane,
        corners_px=corners_px,
        outline_px=outline_px,
        levels=levels,
        renderer=mapped(str, "renderer"),
        background=column("background").listed(count),
        effects=SceneEffects(
            strengths, coded, present, active, column("noise_key").broadcast(count, np.uint64),
            plugins,
        ),
    )


def build_cameras(values: Mapping[str, Any], count: int) -> Cameras:
    """Return ``count`` cameras from the camera's parameters, as :func:`build_scenes` has them."""
    columns = {name: Column.of(values[name]) for name in (*VIEW_PARAMETERS, "distortion")}
    view = [
        np.broadcast_to(np.asarray(number, dtype=np.float64), (count,))
        for number in intrinsics(
            *(None if columns[name].missing else columns[name].broadcast(count)
              for name in VIEW_PARAMETERS)
        )
    ]
    lenses, lens = distinct(columns["distortion"].map(tuple).listed(count))
    return Cameras(
        np.stack(view, axis=1),
        np.array([lens_model.pack(coefficients) for coefficients in lenses])[lens],
        np.array([len(coefficients) > 0 for coefficients in lenses], dtype=bool)[lens],
    )


def distinct(keys: Sequence[Key]) -> tuple[tuple[Key, ...], NDArray[np.int64]]:
    """Return the distinct keys of N in order of appearance, and the index (N,) of each key."""
    number: dict[Key, int] = {}
    index = [number.setdefault(key, len(number)) for key in keys]
    return tuple(number), np.array(index, dtype=np.int64)
