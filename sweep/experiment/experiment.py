"""The experiment: what a pipeline asks for, resolved once in each process, and facts on it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sweep.experiment import draws
from sweep.experiment.grid import TRIAL, Axis, Block, Grid
from sweep.experiment.parameters import NAMED_BY, PARAMETERS, WORLD, Stage
from sweep.experiment.photographs import recorded_poses
from sweep.experiment.schema import Variable, drawn_variables, variables_of
from sweep.measure import detectors
from sweep.measure.detectors import AnyDetectorSetting, BoardDetectorSetting, PluginSetting
from sweep.measure.estimators import SOLVERS, EstimatorSetting, PluggedEstimatorSetting
from sweep.measure.likelihood import BoundSetting
from sweep.messages import label
from sweep.model import camera, effects
from sweep.model.board_kinds import ARRANGING, arranged_board
from sweep.model.camera import Column, canonical_distortion, map_columns
from sweep.model.effects import EFFECTS, Effect, ScenePlugins, checked_effect, checked_renderer
from sweep.model.exposure import hidden, not_modelled, outside_frame
from sweep.model.pose import angles_of_rotation, viewing_angle
from sweep.model.scene import Scenes, build_cameras, build_scenes
from sweep.plugins.loading import DeclaredPlugin
from sweep.typing import Floats, Masks

T = TypeVar("T")


def _column(values: Sequence[Any], indices: NDArray[np.intp]) -> Column:
    """Return a parameter's values along an axis at indices (N,)."""
    low, high = int(indices.min()), int(indices.max()) + 1
    part = values[low:high]
    if isinstance(part, range):
        return Column.of(part.start + part.step * (indices - low))
    if isinstance(part[0], (int, float)) and not any(isinstance(v, (bool, str)) for v in part):
        return Column.of(np.asarray(part, dtype=np.float64)[indices - low])
    return Column.of([part[index] for index in (indices - low).tolist()])


#: Values of parameters that differ from marker to marker in a photograph, as if they did not.
ANY_MARKER = {
    name: Column(PARAMETERS[name].default, constant=True) for name in ("marker_id", "size_m")
}


def _names(declaring: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(declaring))


#: Parameters of the scene's stage that do not change its image.
NOT_IN_IMAGE = {
    "window", "camera_file", "calibration_sd", "calibration_covariance", *_names(BoundSetting),
}


def _made(declaring: type[T], values: Mapping[str, Any]) -> T:
    """Return a record whose fields have the values of their names."""
    return declaring(**{name: values[name] for name in _names(declaring)})


def effect_of(plugin: DeclaredPlugin) -> Effect:
    """Return the effect of a plug-in, which is not imported for it: it lacks its function."""
    return Effect(
        plugin.name, plugin.step, {each.name: each for each in plugin.settings},
        random=plugin.random, widens=plugin.widens)


# --------------------------------------------------------------------------------------------------
# The experiment: what a pipeline asks for, resolved once in each process.

class Experiment:
    """A compiled pipeline: axes, draws, settings and variables, resolved once.

    Attributes
    ----------
    grid
        The values, axes and distributions of the pipeline.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid

    @cached_property
    def scene_axes(self) -> tuple[Axis, ...]:
        """The axes that blocks are cut along."""
        return self.grid.axes_of(Stage.scene)

    @cached_property
    def all_scenes(self) -> Block:
        """All its scenes, as one block."""
        lengths = tuple(len(axis) for axis in self.scene_axes)
        return Block((0,) * len(lengths), lengths)

    @cached_property
    def target_axes(self) -> tuple[Axis, ...]:
        """The axes along which targets differ by more than a number: compared, never averaged."""
        return tuple(
            axis for axis in self.scene_axes if len(axis) > 1 and not axis.is_numeric
            and any(each.section in ("marker", "board") for each in axis.parameters))

    @cached_property
    def detectors(self) -> list[AnyDetectorSetting]:
        """The detector settings, in the order of the detection axes."""
        return [own or _made(detectors.DetectorSetting, values)
                for values, own in self._settings("detector")]

    @cached_property
    def board_settings(self) -> list[BoardDetectorSetting]:
        """The settings of boards of the detector settings, in their order."""
        return [_made(BoardDetectorSetting, values)
                for values, _ in self._settings("detector")]

    @cached_property
    def estimators(self) -> list[EstimatorSetting]:
        """The estimators, in the order of the estimation axes."""
        return [_made(PluggedEstimatorSetting, values | {"own": own}) if own
                else _made(EstimatorSetting, values)
                for values, own in self._settings("estimator")]

    @cached_property
    def solvers_on_pixels(self) -> list[str]:
        """The solvers for which the detections' images are kept."""
        return [*dict.fromkeys(each.solver for each in self.estimators if each.record.needs_images)]

    def _settings(self, section: str) -> Iterator[tuple[dict[str, Any], PluginSetting | None]]:
        """Yield the values of a section at all combinations of its axes, in their order.

        Beside them the settings of the plug-in that they name; None for what is built in.
        """
        grid = self.grid
        # What is drawn has no value on the grid, and its default here.
        defaults = {p.name: p.default for p in grid.parameters.values() if p.section == section}
        for row in grid.rows(list(defaults)):
            values = defaults | row
            plugin = grid.plugin(section, values[NAMED_BY[section].name])
            yield values, None if plugin is None else PluginSetting(
                plugin, tuple((each.name, values[each.name]) for each in plugin.settings),
                grid.folder)

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """The built-in effects and those of plug-ins, which are not imported for it."""
        return (*EFFECTS, *(effect_of(each) for each in self.grid.plugins if each.kind == "effect"))

    @cached_property
    def scene_plugins(self) -> ScenePlugins:
        """The effects and renderers of plug-ins, imported.

        Raises
        ------
        PluginError
            If one is not the plug-in that was declared; in one line.
        """
        effects, renderers, settings = [*EFFECTS], {}, []
        for plugin in self.grid.plugins:
            if plugin.kind == "effect":
                apply = checked_effect(plugin.name, plugin.record(self.grid.folder).apply)
                effects.append(dataclasses.replace(effect_of(plugin), apply=apply))
            elif plugin.kind == "renderer":
                render = plugin.record(self.grid.folder).render
                renderers[plugin.name] = checked_renderer(plugin.name, render)
                settings += [setting.name for setting in plugin.settings]
        return ScenePlugins(tuple(effects), renderers, tuple(settings))

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables of the dataset: the schema's, then draws."""
        return variables_of(self.grid)

    @cached_property
    def drawn(self) -> tuple[Variable, ...]:
        """The variables that hold each scene's drawn values."""
        return drawn_variables(self.grid)

    @cached_property
    def cell_shapes(self) -> dict[str, tuple[int, ...]]:
        """Variable -> its configurations, then the lengths of its inner dimensions."""
        return {variable.name: (variable.configurations(self.grid), *variable.inner_shape)
                for variable in self.variables}

    def bytes_of(self, scenes: int) -> int:
        """Return the uncompressed bytes that ``scenes`` scene cells take in the store."""
        return scenes * sum(
            math.prod(self.cell_shapes[variable.name]) * np.dtype(variable.dtype).itemsize
            for variable in self.variables)

    def _given(
        self, indices: Sequence[NDArray[np.intp]]
    ) -> tuple[dict[str, Column], NDArray[np.int64]]:
        """Return the scene parameters as they are given at ``indices``, and the trials (N,)."""
        values = dict(self._constants)
        for axis, index in zip(self.scene_axes, indices, strict=True):
            values |= {name: _column(along, index) for name, along in axis.columns.items()}
        count = len(indices[0]) if self.scene_axes else 1
        return values, values.pop(TRIAL, Column(0, constant=True)).broadcast(count, np.int64)

    @cached_property
    def _constants(self) -> dict[str, Column]:
        """The scene's parameters that are fixed; made once, not for each block."""
        parameters = self.grid.parameters
        return {name: Column(value, constant=True) for name, value in self.grid.fixed.items()
                if parameters[name].stage is Stage.scene}

    def scene_values(self, indices: Sequence[NDArray[np.intp]]) -> dict[str, Column]:
        """Return the scene parameters' values for scenes at ``indices`` (N,) along each scene axis.

        Random ones are drawn (those of later stages too), the pose is resolved, lenses are
        canonical, images are absolute paths, and ``shift_u_px``, ``shift_v_px`` are the jitter.
        """
        grid = self.grid
        values, trials = self._given(indices)
        count = len(trials)
        values["distortion"] = values["distortion"].map(canonical_distortion)
        if grid.shows_boards:
            values["board"] = map_columns(arranged_board, [values[name] for name in ARRANGING])
        drawn = grid.distributions
        if "background" not in drawn:
            values["background"] = values["background"].map(lambda value: (
                str((Path(grid.folder) / value).resolve()) if isinstance(value, str) else value))
        jitter = np.asarray(values["jitter_px"].values, dtype=np.float64)
        values |= dict.fromkeys(draws.SHIFTS, Column.of(0.0))
        noisy = any(effect.switch in drawn or values[effect.switch].differs_from(effect.off)
                    for effect in self.effects if effect.random)
        poses = {} if values["photographs"].missing else recorded_poses(
            values, trials, grid.folder, simulated=grid.is_simulated)
        if grid.shows_photographs:
            return values | poses
        given, calibration = dict(values), grid.calibration
        keys = cache(partial(draws.geometry_keys, given, drawn, count))
        # What is drawn for a photograph is the same for all its markers; their noise is not.
        shared = keys if not poses else cache(
            partial(draws.geometry_keys, given | ANY_MARKER, drawn, count))
        # Quantities that are drawn together: the jitter comes after the distributions, so that
        # whether there is any changes nothing for them.
        together = [*sorted(drawn), *draws.SHIFTS, *(
            draws.CALIBRATED + name for name in (calibration.names if calibration else ()))]

        def draw(quantity: str, keys: Callable[[], NDArray[np.uint64]] = keys) -> Floats:
            dimension = together.index(quantity) if grid.sampling == "sobol" else None
            return draws.uniform(grid.seed, quantity, keys(), trials, dimension)

        for name, distribution in drawn.items():
            values[name] = Column.of(distribution.at(draw(name, shared)))
        if (jitter > 0).any():
            for name in draws.SHIFTS:
                values[name] = Column.of(jitter * (2 * draw(name) - 1))
        if calibration:
            values |= draws.calibrated_columns(calibration, values, count, draw)
        if noisy:
            values["noise_key"] = Column.of(draws.bits(grid.seed, "noise", keys(), trials))
        draws.resolve_pose(values)
        return values | poses

    # A key of each image: a function of its scene's own parameters and draws, not of the grid.
    #
    # By it an image that was exported is recognised again: on another grid that has the same
    # scene, or as a single cell. Keys are hashes of the texts of all parameters that change the
    # image, sorted by name, defaults left out, numbers rounded to 12 significant digits, mixed
    # with the seed and the trial.

    def image_keys(self, indices: Sequence[NDArray[np.intp]]) -> NDArray[np.uint64]:
        """Return the keys (N,) of the images of scenes at ``indices`` (N,) along the scene axes."""
        grid = self.grid
        values, trials = self._given(indices)
        if "background" in values:  # an image is known by its content
            values["background"] = values["background"].map(
                lambda value: grid.files.get(value) or value)
        texts = [draws.key_texts(name, values[name], grid.parameters[name].default)
                 for name in sorted(values.keys() - NOT_IN_IMAGE - grid.distributions.keys())]
        texts += [Column.of(f"{name}={distribution}")
                  for name, distribution in sorted(grid.distributions.items())
                  if grid.parameters[name].stage is Stage.scene]
        keys = draws.hashed(texts, len(trials))
        return draws.bits(grid.seed, f"image {grid.sampling}", keys, trials)


# --------------------------------------------------------------------------------------------------
# The settings that a configuration uses: an axis may hold others, which change nothing for it.

def used_settings(pipeline: Grid, values: Mapping[str, Any]) -> dict[str, Any]:
    r"""Return the axes' values that are settings of the detector and the solver among them.

    ``values`` has an axis' name -> its value, or its label if parameters go together.

    Examples
    --------
    >>> from sweep.experiment.pipeline import Pipeline
    >>> pipeline = Pipeline.from_text(
    ...     "seed = 1\n[pose]\nside_px = 40\n[axes]\n"
    ...     'solver = ["ippe", "sqpnp"]\nestimate_blur = [false, true]\n')
    >>> used_settings(pipeline, {"solver": "ippe", "estimate_blur": True})
    {'solver': 'ippe'}
    """
    # Each setting that some detectors or solvers have and others lack, with its owner.
    owned = [("detector", detectors.OPENCV, {*_names(detectors.DetectorSetting)})]
    owned += [("solver", name, {*solver.own, *["guarded"] * solver.guarded})
              for name, solver in SOLVERS.items()]
    owned += [(NAMED_BY[plugin.kind].name, plugin.name, {each.name for each in plugin.settings})
              for plugin in pipeline.plugins if plugin.kind in NAMED_BY]
    axes = {name: pipeline.axis(name) for name in values}
    unused: set[str] = set()
    for named_by in ("detector", "solver"):
        chosen = set(pipeline.values_of(named_by))
        for name, axis in axes.items():
            if axis is not None and named_by in axis.columns and values[name] in axis.values:
                chosen = {axis.at(axis.values.index(values[name]))[named_by]}
        if len(chosen) == 1:
            unused |= {setting for kind, _, own in owned for setting in own if kind == named_by}
            unused -= {setting for kind, owner, own in owned for setting in own
                       if kind == named_by and owner in chosen}
    return {name: value for name, value in values.items()
            if (axis := axes[name]) is None or not unused.issuperset(axis.columns)}


def distinct(pipeline: Grid, combinations: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the indices of the combinations of axes' values that no earlier one means, too."""
    first: dict[tuple[tuple[str, Any], ...], int] = {}
    for index, values in enumerate(combinations):
        first.setdefault(tuple(used_settings(pipeline, values).items()), index)
    return list(first.values())


def wrong_beliefs(pipeline: Grid, axis: Axis) -> tuple[bool, ...]:
    r"""Return for each value of an axis whether it makes the estimator believe what is not true.

    A belief whose truth varies over the grid is right somewhere, and counts as not wrong.

    Examples
    --------
    >>> from sweep.experiment.pipeline import Pipeline
    >>> pipeline = Pipeline.from_text(
    ...     "seed = 1\n[pose]\nside_px = 40\n[axes]\nbelieved_focal_scale = [0.99, 1.0]\n")
    >>> wrong_beliefs(pipeline, pipeline.axes[0])
    (True, False)
    """
    fixed = pipeline.fixed
    truths = {f"believed_{name}": fixed.get(name) for name in ("size_m", "blur_px", "noise_grey")}
    truths |= {"believed": "truth", "believed_focal_scale": 1.0}
    if "distortion" in fixed:
        truths["believed_distortion"] = canonical_distortion(fixed["distortion"])
    if fixed.keys() >= {*camera.VIEW_PARAMETERS}:
        view = camera.intrinsics(*(fixed[name] for name in camera.VIEW_PARAMETERS))
        truths |= zip((f"believed_{name}_px" for name in ("fx", "fy", "cx", "cy")), view,
                      strict=True)
    return tuple(
        any(_differs(value, truths.get(name)) for name, value in axis.at(k).items())
        for k in range(len(axis)))


def wrong_configurations(pipeline: Grid, axes: Sequence[Axis]) -> list[bool]:
    """Return for each combination of axes' values, the last fastest, whether a belief is wrong.

    Nowhere, if that is so for all of them: then none is the true one that others differ from.
    """
    wrong = [any(flags) for flags in itertools.product(
        *(wrong_beliefs(pipeline, axis) for axis in axes))]
    return [False] * len(wrong) if all(wrong) else wrong


def _differs(believed: Any, truth: Any) -> bool:
    """Return whether a belief is known to differ from the truth, beyond rounding."""
    if believed is None or truth is None:
        return False
    if isinstance(believed, (int, float)):
        return not math.isclose(believed, truth, rel_tol=1e-9)
    lens = isinstance(believed, tuple)
    return bool((canonical_distortion(believed) if lens else believed) != truth)


#: Scenes that are looked at, of a larger grid: its corners first, then scenes anywhere.
MAX_SAMPLE = 600

#: The most corners of a grid that are looked at.
MAX_CORNERS = 200

#: Distance of the principal point from the frame's centre, as a share of its side, that is told.
OFF_CENTRE = 0.15

#: Share of poses that is told.
MIN_SHARE = 0.01


def _ends(numbers: Floats) -> tuple[float, float]:
    """Return the least and the largest number."""
    return float(np.min(numbers)), float(np.max(numbers))


def _text(numbers: Sequence[float] | Floats, digits: int = 6) -> str:
    """Return the least and the largest of some numbers; one of them if they print alike."""
    low, high = (f"{round(float(end), 9) + 0.0:.{digits}g}" for end in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"


@dataclass(frozen=True, slots=True)
class Part:
    """An optional part of the work.

    Attributes
    ----------
    name
        Its name.
    active, reason
        Whether it runs, and why.
    switch
        Of an effect: the parameter that switches it on.
    """

    name: str
    active: bool
    reason: str
    switch: str = ""


class Facts:
    """Facts on an experiment's camera and poses, its active parts, and notes on surprises.

    Of large grids, and of what is drawn, by the scenes that are looked at. `sweep plan` prints all
    of it; the start of a run prints the notes.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment, self.grid = experiment, experiment.grid

    @cached_property
    def _sample(self) -> tuple[int, dict[str, Column]]:
        """The number of the scenes that are looked at, and the values of their parameters.

        Every quantity of a camera is monotonic in each of its parameters, so that the corners of
        the grid have its ends.
        """
        scenes = self.experiment.all_scenes
        if len(scenes) <= MAX_SAMPLE:
            return len(scenes), self.experiment.scene_values(scenes.indices())
        # The bits of a corner's number say at which end of each axis it is.
        corners = np.arange(min(2 ** len(scenes.stops), MAX_CORNERS))
        anywhere = np.random.default_rng(0)
        return MAX_SAMPLE, self.experiment.scene_values([
            np.concatenate([(corners >> k & 1) * (length - 1),
                            anywhere.integers(0, length, MAX_SAMPLE - len(corners))])
            for k, length in enumerate(scenes.stops)])

    # The camera.

    @cached_property
    def camera(self) -> dict[str, Any]:
        """Each quantity of the camera: its least and its largest value.

        Frame, focal lengths and principal point in px; hfov_deg and vfov_deg, the angle between
        the frame's edges without lens distortion, 2 atan(width / (2 fx)); aspect, fy / fx: the
        width of a pixel over its height; off_centre_x and off_centre_y, the principal point minus
        the frame's centre, as a share of its width and height; square, whether the pixels are
        square everywhere on the grid; side_px of the black square parallel to the image plane, at
        the farthest and the nearest pose, None if all are behind the camera, of boards the sides
        of the smallest and the largest marker; boards, whether scenes show boards.
        """
        count, values = self._sample
        fx, fy, cx, cy = build_cameras(values, count).view.T
        width, height, side, size, distance = (values[name].broadcast(count) for name in (
            "width_px", "height_px", "side_px", "size_m", "distance_m"))
        with np.errstate(divide="ignore"):
            sides = fx * size / distance if values["side_px"].missing else side
        sides = sides[sides > 0]  # before the camera
        numbers = {
            "width_px": width, "height_px": height, "fx_px": fx, "fy_px": fy, "cx_px": cx,
            "cy_px": cy, "hfov_deg": camera.field_of_view_deg(width, fx),
            "vfov_deg": camera.field_of_view_deg(height, fy), "aspect": fy / fx,
            "off_centre_x": (cx - (width - 1) / 2) / width,
            "off_centre_y": (cy - (height - 1) / 2) / height,
        }
        return {name: _ends(each) for name, each in numbers.items()} | {
            "square": bool(np.all(camera.are_square(fx, fy))),
            "side_px": tuple(np.multiply(_ends(sides), self.grid.relative_sizes).tolist())
            if len(sides) else None,
            "boards": self.grid.shows_boards,
        }

    @property
    def _frame(self) -> str:
        """The frame's size, in words."""
        return f"{_text(self.camera['width_px'])} x {_text(self.camera['height_px'])} px"

    @property
    def camera_line(self) -> str:
        """The camera in one line."""
        camera = self.camera
        focal = f"fx = fy = {_text(camera['fx_px'])} px" if camera["square"] else (
            f"fx = {_text(camera['fx_px'])} px, fy = {_text(camera['fy_px'])} px "
            f"(pixels are not square: fy/fx = {_text(camera['aspect'], 4)})")
        whose = "the markers' sides are" if camera["boards"] else "the marker's side is"
        sides = camera["side_px"] and f", {whose} {_text(camera['side_px'], 4)} px"
        return (f"{self._frame}, {focal}, HFOV {_text(camera['hfov_deg'], 4)}°, "
                f"VFOV {_text(camera['vfov_deg'], 4)}°{sides or ''}")

    @property
    def camera_attributes(self) -> dict[str, Any]:
        """The dataset's attributes of the camera: a number, or the least and the largest one."""
        ends = {name: self.camera[name] for name in ("fx_px", "fy_px", "hfov_deg", "vfov_deg")}
        sides = zip(("farthest_side_px", "nearest_side_px"), self.camera["side_px"] or (),
                    strict=False)
        return {f"camera_{name}": low if low == high else [low, high]
                for name, (low, high) in ends.items()} | dict(sides)

    @property
    def camera_notes(self) -> Iterator[str]:
        """A line for each property of the camera that may surprise."""
        for axis in "xy":
            centre = f"c{axis}_px = {_text(self.camera[f'c{axis}_px'])}"
            off = max(map(abs, self.camera[f"off_centre_{axis}"]))
            if off > 0.5:
                yield f"{centre}: outside the frame of {self._frame}"
            elif off > OFF_CENTRE:
                yield (f"{centre}: far from the centre of the frame of {self._frame}; is it that "
                       "of another frame size?")
        x, y = (self.camera[name][0] / 2 for name in ("width_px", "height_px"))
        if (self.camera["cx_px"], self.camera["cy_px"]) == ((x, x), (y, y)):
            yield (f"cx_px = {x:g}, cy_px = {y:g}: half the frame; with pixel (0, 0) at the "
                   f"pixel's centre, as here, the middle is {x - 0.5:g}, {y - 0.5:g}: subtract 0.5 "
                   "if the program that gave them has its corner there "
                   "(pipelines/half_pixel/README.md)")

    # The poses.

    @cached_property
    def _scenes(self) -> Scenes:
        """The scenes that are looked at."""
        count, values = self._sample
        return build_scenes(values, count)

    @cached_property
    def view_ranges(self) -> dict[str, list[float]]:
        """The least and the largest of three quantities of the scenes that are looked at.

        Tilt to the image plane, angle to the line of sight, distance of the centre.
        """
        rotation, translation = self._scenes.rotation, self._scenes.translation
        return {
            "tilt_deg": [*_ends(np.degrees(angles_of_rotation(rotation)[0]))],
            "viewing_angle_deg": [*_ends(np.degrees(viewing_angle(rotation, translation)))],
            "range_m": [*_ends(np.linalg.norm(translation, axis=1))],
        }

    @property
    def pose_line(self) -> str:
        """The poses in one line."""
        count, _ = self._sample
        tilt, angle, distance = (_text(ends, 4) for ends in self.view_ranges.values())
        sample = f" ({count:,} poses looked at)" * (count < len(self.experiment.all_scenes))
        return f"tilt {tilt}°, viewing angle {angle}°, {distance} m away{sample}"

    def _share(self, chosen: Masks) -> str:
        """Return the share of the poses that are ``chosen``, in words."""
        whole = len(chosen) >= len(self.experiment.all_scenes)
        if chosen.all():
            return "all poses" if whole else f"all {len(chosen):,} poses looked at"
        return f"{'' if whole else 'about '}{100 * chosen.mean():.2g} % of the poses"

    @property
    def pose_notes(self) -> Iterator[str]:
        """A line for each reason for which markers are not wholly seen; the first counts."""
        scenes, target, corners = self._scenes, self.grid.target_word, self._scenes.corners_px
        within = f"; frame_x and frame_y place a {target} within it" * (
            self.grid.given.isdisjoint((*WORLD, "frame_x", "frame_y")))
        behind = ~np.isfinite(scenes.outline_px).all(axis=(1, 2))
        turned, folded = hidden(scenes), not_modelled(scenes)
        # Of scenes that nothing else keeps from being seen: others have no place in the frame.
        outside, rows = np.zeros_like(behind), np.flatnonzero(~(behind | turned | folded))
        outside[rows] = outside_frame(scenes, rows)
        cut = ((corners < -0.5) | (corners > scenes.frame[:, None, :] - 0.5)).any((1, 2))
        left = np.ones_like(behind)
        for reason, what in (
            (behind, "have a corner behind the camera: not_visible"),
            (turned,
             f"show the {target}'s back or edge (a viewing angle of 90° or more): not_visible"),
            (folded,
             "lie where the lens folds, or bend or move out of what is modelled: not_modelled"),
            (outside, f"are outside the frame: not_visible{within}"),
            (cut, "are cut off by the frame's edge"),
        ):
            chosen = left & reason
            left &= ~chosen
            if chosen.mean() > MIN_SHARE:
                yield f"{self._share(chosen)} {what}"

    # The detections, and all notes.

    @property
    def detector_notes(self) -> Iterator[str]:
        """A line for each property of the detections that may surprise."""
        squares = ["aprilgrid" in self.grid.values_of("kind"),
                   *self.grid.values_of("corner_squares")]
        if any(squares) and self.grid.given.isdisjoint(("adaptiveThreshConstant", "detector")):
            yield ("board: squares touch its markers' corners, and OpenCV's default threshold "
                   "joins both: it finds a third of sharp markers; adaptiveThreshConstant = 60, "
                   "adaptiveThreshWinSizeMax = 33 and adaptiveThreshWinSizeStep = 4 find four in "
                   "five (pipelines/boards/README.md)")
        if "apriltag" in self.grid.values_of("cornerRefinementMethod"):
            yield ("cornerRefinementMethod = apriltag: OpenCV's corners are 0.4 to 0.5 px right of "
                   "and below those of its other refinements, and of its calibrations: half a "
                   "pixel in position and direction (pipelines/half_pixel/README.md)")

    @property
    def notes(self) -> list[str]:
        """The lines that `sweep plan` and the start of a run print."""
        return [] if "photographs" in self.grid.given else [
            *self.camera_notes, *self.pose_notes, *self.detector_notes]

    @cached_property
    def parts(self) -> list[Part]:
        """Every optional part, active or not."""
        grid, calibrated = self.grid, self.grid.calibration is not None
        of_effects = [*map(self._effect, self.experiment.effects)]
        on = [effect for effect, part in zip(self.experiment.effects, of_effects, strict=True)
              if part.active]
        random = dict.fromkeys([
            *grid.distributions, *["jitter_px"] * grid.any_value("jitter_px", bool),
            *(each.switch for each in on if each.random),
            *["the believed calibration"] * calibrated])
        lens = any(map(canonical_distortion, grid.values_of("distortion")))
        image = grid.any_value("background", lambda value: isinstance(value, str))
        noisy = any(effect.switch in random for effect in on if effect.widens == "noise")
        coarse = any("noise" in effect.worsens for effect in on)
        around = f" px around the {grid.target_word}'s pixels" + (
            f", and {detectors.NOISE_MARGIN_PX * (1 + coarse)} more for noise" if noisy else "")
        windows = {detectors.margin_px(each) for each in self.experiment.detectors
                   if detectors.full_frame_reason(each) is None and not image
                   and "full" not in grid.values_of("window")}
        assumptions = [name for name in PARAMETERS if name.startswith("believed_")
                       and grid.fixed.get(name, "varies") is not None]
        # Why each is active, and what is said if nothing is a reason.
        reasons: dict[str, tuple[Iterable[str], str]] = {
            "lens distortion": (["distortion is given"] * lens, "distortion is empty"),
            "random draws": (
                [*random, *["Sobol' points"] * (grid.sampling == "sobol")], "nothing is random"),
            "background image": (["background names a file"] * image, "a level"),
            "window": ([", ".join(map(str, sorted(windows))) + around] * bool(windows),
                       "the full frame"),
            "plug-ins": (map(_described, grid.plugins), "none is named"),
            "full frame": (self._reasons_for_the_frame(on, image=image), "no setting needs it"),
            "renderer": (sorted(set(grid.values_of("renderer"))), ""),
            "solver guard": (["guarded = true"] * grid.any_value("guarded", bool),
                             "guarded = false: plain cv2.solvePnP"),
            "accuracy bound": ([f"bound is {each}" for each in sorted(set(
                grid.values_of("bound"))) if each != "none"], "bound is none"),
            "pixels kept": (
                [f"solver {each} needs them" for each in self.experiment.solvers_on_pixels],
                "no solver needs them"),
            "wrong assumptions": ([*assumptions, *["believed: calibration"] * calibrated],
                                  "the estimator knows the true camera and size"),
        }
        listed = [Part(name, bool(text := ", ".join(each)), text or otherwise)
                  for name, (each, otherwise) in reasons.items()]
        return listed + of_effects

    def _reasons_for_the_frame(self, on: Sequence[Effect], *, image: bool) -> list[str]:
        """Return why the whole frame is searched, given the effects that are on."""
        settings, word = self.experiment.detectors, self.grid.target_word
        reasons = sorted(filter(None, {*map(detectors.full_frame_reason, settings)}))
        gain = math.inf if any("uneven light" in effect.worsens for effect in on) else max(
            [1.0, *self.grid.values_of("gain")])
        if any(effect.widens == "uneven light" for effect in on) and any(
                detectors.uneven_light_needs_frame(setting, gain) for setting in settings):
            reasons.append("adaptiveThreshConstant is low for uneven light")
        if image:
            reasons.append(
                f"the background is an image: clutter near the {word} may change the detection")
        return reasons + ['window = "full"'] * ("full" in self.grid.values_of("window"))

    def _effect(self, effect: Effect) -> Part:
        switch, drawn = effect.switch, self.grid.distributions.get(effect.switch)
        if drawn is not None:
            return Part(effect.label, True, f"{switch} is drawn: {drawn}", switch)
        values = [value for value in self.grid.values_of(switch) if value != effect.off]
        coded = effects.is_coded(effect.off) or not values
        text = ", ".join(dict.fromkeys(map(label, values))) if coded else _text(values)
        return Part(effect.label, bool(values), f"{switch} is {text or effect.off_text}", switch)


def _described(plugin: DeclaredPlugin) -> str:
    """Return a plug-in in words: kind, name, versions."""
    versions = ", ".join(f"{name} {version}" for name, version in plugin.versions)
    return f"{plugin.kind} {plugin.name}" + (f" ({versions})" if versions else "")
