"""The experiment: what a pipeline asks for, resolved once in each process."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.axes import TRIAL, Axis, combinations
from sweep.experiment.draws import (
    CALIBRATED,
    SHIFTS,
    bits,
    calibrated_columns,
    geometry_keys,
    hashed,
    key_texts,
    resolve_pose,
    uniform,
)
from sweep.experiment.grid import Block, Grid
from sweep.experiment.parameters import PARAMETERS, PHOTOGRAPHS, Stage
from sweep.experiment.photographs import recorded_poses
from sweep.experiment.schema import Variable, drawn_variables, variables_of
from sweep.measure.bound import BoundSetting
from sweep.measure.detectors import AnyDetectorSetting, BoardDetectorSetting, DetectorSetting
from sweep.measure.estimators import EstimatorSetting, PluggedEstimatorSetting
from sweep.model.board_kinds import ARRANGING, arranged_board
from sweep.model.camera import Column, canonical_distortion, map_columns
from sweep.model.effects import EFFECTS, Effect, ScenePlugins, checked_effect, checked_renderer
from sweep.plugins import EffectPlugin, RendererPlugin
from sweep.plugins.declared import DeclaredPlugin, PluginSetting
from sweep.typing import Floats

T = TypeVar("T")


def _column(values: Sequence[Any], indices: NDArray[np.intp]) -> Column:
    """Return a parameter's values along an axis at indices (N,)."""
    low, high = int(indices.min()), int(indices.max()) + 1
    part = values[low:high]
    if isinstance(part, range):
        return Column.of(part.start + part.step * (indices - low))
    if isinstance(part[0], (int, float)) and not any(isinstance(v, (bool, str)) for v in part):
        return Column.of(np.asarray(part, dtype=np.float64)[indices - low])
    return Column.of([part[i] for i in (indices - low).tolist()])


ANY_MARKER = {
    name: Column(PARAMETERS[name].default, constant=True) for name in ("marker_id", "size_m")
}
"""Values of what differs from marker to marker in a photograph, as if it did not."""


def _absolute(folder: str, background: Any) -> Any:
    """Return an image's absolute path; a grey level as it is."""
    return str((Path(folder) / background).resolve()) if isinstance(background, str) else background


def _names(declaring: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(declaring))


OPENCV_FIELDS = _names(DetectorSetting)

NOT_IN_IMAGE = {
    "window", "camera_file", "calibration_sd", "calibration_covariance", *_names(BoundSetting),
}
"""Parameters of the scene's stage that do not change its image."""


def _made(declaring: type[T], values: Mapping[str, Any]) -> T:
    """Return a record whose fields have the values of their names."""
    return declaring(**{name: values[name] for name in _names(declaring)})


def effect_of(plugin: DeclaredPlugin) -> Effect:
    """Return the effect of a plug-in, which is not imported for it: it lacks its function."""
    widens: Any = plugin.widens
    step: Any = plugin.step
    parameters = {setting.name: setting for setting in plugin.settings}
    return Effect(plugin.name, step, parameters, random=plugin.random, widens=widens)


TARGET_SECTIONS = ("marker", "board", "target")
"""Sections of a pipeline whose parameters tell targets apart."""


# --------------------------------------------------------------------------------------------------
# The experiment: what a pipeline asks for, resolved once in each process.

class Experiment:
    """What follows from a checked pipeline: axes, draws, settings and variables, resolved once.

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
            and any(each.section in TARGET_SECTIONS for each in axis.parameters))

    @cached_property
    def detectors(self) -> list[AnyDetectorSetting]:
        """The detector settings, in the order of the detection axes."""
        return [
            self._plugged("detector", values["detector"], values) or _made(DetectorSetting, values)
            for values in self._settings("detector", Stage.detection)
        ]

    @cached_property
    def board_settings(self) -> list[BoardDetectorSetting]:
        """What the detector settings do with boards, in their order."""
        return [_made(BoardDetectorSetting, values)
                for values in self._settings("detector", Stage.detection)]

    @cached_property
    def estimators(self) -> list[EstimatorSetting]:
        """The estimators, in the order of the estimation axes."""
        return [
            _made(EstimatorSetting, values) if own is None
            else _made(PluggedEstimatorSetting, values | {"own": own})
            for values in self._settings("estimator", Stage.estimation)
            for own in [self._plugged("estimator", values["solver"], values)]
        ]

    def _settings(self, section: str, stage: Stage) -> list[dict[str, Any]]:
        """Return the values of a section at all combinations of a stage's axes, in their order."""
        fixed = {
            p.name: self.grid.fixed.get(p.name, p.default)
            for p in self.grid.parameters.values() if p.section == section
        }
        return [fixed | chosen for chosen in combinations(self.grid.axes_of(stage))]

    def _plugged(self, kind: str, name: str, values: Mapping[str, Any]) -> PluginSetting | None:
        """Return the settings of a plug-in; None for what is built in."""
        plugin = self.grid.plugin(kind, name)
        if plugin is None:
            return None
        own = tuple((setting.name, values[setting.name]) for setting in plugin.settings)
        return PluginSetting(plugin, own, self.grid.folder)

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """The built-in effects and those of plug-ins, which are not imported for it."""
        return (*EFFECTS, *(effect_of(each) for each in self.grid.plugins if each.kind == "effect"))

    @cached_property
    def scene_plugins(self) -> ScenePlugins:
        """What plug-ins add to the scenes, imported.

        Raises
        ------
        PluginError
            If one is not the plug-in that was declared; in one line.
        """
        effects, renderers, settings = [], {}, []
        for plugin in self.grid.plugins:
            if plugin.kind == "effect":
                effect = cast("EffectPlugin", plugin.record(self.grid.folder))
                applied = checked_effect(plugin.name, effect.apply)
                effects.append(effect_of(plugin).applying(applied))
            elif plugin.kind == "renderer":
                renderer = cast("RendererPlugin", plugin.record(self.grid.folder))
                renderers[plugin.name] = checked_renderer(plugin.name, renderer.render)
                settings += [setting.name for setting in plugin.settings]
        return ScenePlugins(tuple(effects), renderers, tuple(settings))

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables of the dataset: the schema's, then draws."""
        return variables_of(self.grid)

    @cached_property
    def drawn(self) -> tuple[Variable, ...]:
        """Those of them that hold what is drawn for each scene."""
        return drawn_variables(self.grid)

    @cached_property
    def cell_shapes(self) -> dict[str, tuple[int, ...]]:
        """Variable -> its configurations, then the lengths of its inner dimensions."""
        return {
            variable.name: (variable.configurations(self.grid), *variable.inner_shape)
            for variable in self.variables
        }

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
        """The scene's parameters that are fixed."""
        return {
            name: Column(value, constant=True) for name, value in self.grid.fixed.items()
            if self.grid.parameters[name].stage is Stage.scene
        }

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
            values["background"] = values["background"].map(partial(_absolute, grid.folder))
        jitter = np.asarray(values["jitter_px"].values, dtype=np.float64)
        values["shift_u_px"] = values["shift_v_px"] = Column.of(0.0)
        noisy = any(
            effect.switch in drawn or values[effect.switch].differs_from(effect.off)
            for effect in self.effects if effect.random
        )
        poses = {} if values[PHOTOGRAPHS].missing else recorded_poses(
            values, trials, grid.folder, simulated=grid.is_simulated)
        if grid.shows_photographs:
            return values | poses
        given = dict(values)
        keys = cache(partial(geometry_keys, given, drawn, count))
        # What is drawn for a photograph is the same for all its markers; their noise is not.
        shared = cache(partial(geometry_keys, given | ANY_MARKER, drawn, count)) if poses else keys
        # Quantities that are drawn together: the jitter comes after the distributions, so that
        # whether there is any changes nothing for them.
        calibration = grid.calibration
        calibrated = () if calibration is None else calibration.names
        together = [*sorted(drawn), *SHIFTS, *(CALIBRATED + name for name in calibrated)]

        def draw(quantity: str, keys: Callable[[], NDArray[np.uint64]] = keys) -> Floats:
            dimension = together.index(quantity) if grid.sampling == "sobol" else None
            return uniform(grid.seed, quantity, keys(), trials, dimension)

        for name, distribution in drawn.items():
            values[name] = Column.of(distribution.at(draw(name, shared)))
        if (jitter > 0).any():
            for name in SHIFTS:
                values[name] = Column.of(jitter * (2 * draw(name) - 1))
        if calibration is not None:
            values |= calibrated_columns(calibration, values, count, draw)
        if noisy:
            values["noise_key"] = Column.of(bits(grid.seed, "noise", keys(), trials))
        resolve_pose(values)
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
        texts = [
            key_texts(name, values[name], grid.parameters[name].default)
            for name in sorted(values.keys() - NOT_IN_IMAGE - grid.distributions.keys())
        ]
        texts += [
            Column.of(f"{name}={distribution}")
            for name, distribution in sorted(grid.distributions.items())
            if grid.parameters[name].stage is Stage.scene
        ]
        return bits(grid.seed, f"image {grid.sampling}", hashed(texts, len(trials)), trials)
