"""What a pipeline's camera and poses are, which parts are active, and what may surprise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sweep.experiment.experiment import Experiment
from sweep.experiment.parameters import FIELDS_OF_VIEW, PARAMETERS, PHOTOGRAPHS, STATED, WORLD
from sweep.measure.detectors import (
    NOISE_MARGIN_PX,
    full_frame_reason,
    margin_px,
    uneven_light_needs_frame,
)
from sweep.measure.estimators import SOLVERS
from sweep.messages import label
from sweep.model.camera import (
    VIEW_PARAMETERS,
    Column,
    are_square,
    canonical_distortion,
    field_of_view_deg,
)
from sweep.model.effects import Effect, is_coded
from sweep.model.exposure import hidden, not_modelled, outside_frame
from sweep.model.marker import module_count
from sweep.model.pose import angles_of_rotation, viewing_angle
from sweep.model.scene import Scenes, build_cameras, build_scenes
from sweep.plugins.declared import DeclaredPlugin
from sweep.typing import Floats, Masks

Range = tuple[float, float]
"""The least and the largest value on the grid."""

MAX_SAMPLE = 600
"""Scenes that are looked at, of a larger grid: its corners first, then scenes anywhere."""

MAX_CORNERS = 200
"""The most corners of a grid that are looked at."""

OFF_CENTRE = 0.15
"""Distance of the principal point from the frame's centre, as a share of its side, that is told."""

WIDE_DEG = 150.0
"""Horizontal field of view above which it is told; lenses without fisheye reach about 130."""

RADIANS = (0.2, math.pi)
"""Fields of view between these look like radians: of 12 to 180 degrees."""

ROUNDED_RAD = 4e-3
"""How far an angle in radians that someone rounded may be from a multiple of 15°."""

NOT_SQUARE = 0.01
"""Difference of fy/fx from 1 that is told; calibrations of square pixels differ by less."""

APART_DEG = 5.0
"""Difference of tilt and viewing angle that is told."""

FARTHER = 1.1
"""Range over depth that is told: a direction of 25° from the optical axis."""

MIN_SHARE = 0.01
"""Share of poses that is told."""


def _ends(numbers: Floats) -> Range:
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
    """What an experiment's camera and poses are, which parts are active, and what may surprise.

    Of large grids, and of what is drawn, by the scenes that are looked at. `sweep plan` prints all
    of it; the start of a run prints the notes.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment, self.grid = experiment, experiment.grid

    @cached_property
    def _sample(self) -> tuple[int, dict[str, Column]]:
        """The number of the scenes that are looked at, and the values of their parameters.

        Every quantity of a camera is monotonic in each of its parameters, so that the corners of
        the grid have its ends; axes of the camera, the size and the distance are varied first.
        """
        axes = self.experiment.scene_axes
        lengths = [len(axis) for axis in axes]
        if math.prod(lengths) <= MAX_SAMPLE:
            indices = [index.ravel() for index in np.indices(lengths, dtype=np.intp)]
            return max(math.prod(lengths), 1), self.experiment.scene_values(indices)
        first = {*VIEW_PARAMETERS, "size_m", "distance_m", "side_px"}
        order = sorted(range(len(axes)), key=lambda k: first.isdisjoint(axes[k].columns))
        # The bits of a corner's number say at which end of each axis it is, in that order.
        corners = np.arange(min(2 ** len(axes), MAX_CORNERS))
        anywhere = np.random.default_rng(0)
        return MAX_SAMPLE, self.experiment.scene_values([
            np.concatenate([
                (corners >> order.index(k) & 1) * (length - 1),
                anywhere.integers(0, length, MAX_SAMPLE - len(corners)),
            ]).astype(np.intp) for k, length in enumerate(lengths)
        ])

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
        width, height = (values[name].broadcast(count) for name in ("width_px", "height_px"))
        given = values["side_px"]
        with np.errstate(divide="ignore"):
            sides = given.broadcast(count) if not given.missing else (
                fx * values["size_m"].broadcast(count) / values["distance_m"].broadcast(count))
        sides = sides[sides > 0]  # before the camera
        numbers = {
            "width_px": width, "height_px": height, "fx_px": fx, "fy_px": fy, "cx_px": cx,
            "cy_px": cy, "hfov_deg": field_of_view_deg(width, fx),
            "vfov_deg": field_of_view_deg(height, fy), "aspect": fy / fx,
            "off_centre_x": (cx - (width - 1) / 2) / width,
            "off_centre_y": (cy - (height - 1) / 2) / height,
        }
        return {name: _ends(each) for name, each in numbers.items()} | {
            "square": bool(np.all(are_square(fx, fy))),
            "side_px": None if not len(sides) else tuple(
                end * scale for end, scale in zip(
                    _ends(sides), self.grid.relative_sizes, strict=True)),
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
        sides = camera["side_px"] and f", {self._whose} {_text(camera['side_px'], 4)} px"
        return (f"{self._frame}, {focal}, HFOV {_text(camera['hfov_deg'], 4)}°, "
                f"VFOV {_text(camera['vfov_deg'], 4)}°{sides or ''}")

    @property
    def _whose(self) -> str:
        """Whose sides the camera sees, in words."""
        return "the markers' sides are" if self.camera["boards"] else "the marker's side is"

    @property
    def camera_attributes(self) -> dict[str, Any]:
        """The dataset's attributes of the camera: a number, or the least and the largest one."""
        return {
            f"camera_{name}": low if low == high else [low, high]
            for name in ("fx_px", "fy_px", "hfov_deg", "vfov_deg")
            for low, high in [self.camera[name]]
        } | dict(zip(("farthest_side_px", "nearest_side_px"), self.camera["side_px"] or (),
                     strict=False))

    @cached_property
    def camera_notes(self) -> list[str]:
        """A line for each property of the camera, or of beliefs about it, that may surprise."""
        return [*self._view_notes(), *self._centre_notes(), *self._side_notes(),
                *self._belief_notes()]

    def _numbers(self, name: str) -> list[float]:
        """Return the numbers of the document for a parameter: the ends or the mean of draws."""
        if (drawn := self.grid.distributions.get(name)) is not None:
            return [drawn.a, drawn.b] if drawn.kind == "uniform" else [drawn.a]
        return [float(value) for value in self.grid.values_of(name) if value is not None]

    def _radians(self, section: str) -> Iterator[str]:
        """Yield a line for each angle of a section whose values look like radians."""
        for name, parameter in PARAMETERS.items():
            if (parameter.section, parameter.unit) != (section, "degree"):
                continue
            angles = np.array([value for value in self._numbers(name) if value])
            steps = np.abs(angles) / (math.pi / 12)
            alike = (angles > RADIANS[0]) & (angles < RADIANS[1]) if name in FIELDS_OF_VIEW else (
                np.abs(steps - np.round(steps)) * (math.pi / 12) < ROUNDED_RAD) & (
                    steps > 0.5) & (steps < 24.5)
            if len(angles) and alike.all():
                largest = max(angles, key=abs)
                yield (f"{name} = {largest:g}: in degrees; {largest:g} radians would be "
                       f"{math.degrees(largest):.4g}")

    def _view_notes(self) -> Iterator[str]:
        aspect, hfov = self.camera["aspect"], _text(self.camera["hfov_deg"], 4)
        if max(abs(ratio - 1) for ratio in aspect) > NOT_SQUARE:
            yield (f"pixels are not square: fy/fx = {_text(aspect, 4)}; a single side of the "
                   "sensor, or fx_px alone, makes them square")
        if self.camera["hfov_deg"][1] > WIDE_DEG:
            yield (f"HFOV {hfov}°: hardly any pinhole camera is as wide; is a focal length in "
                   "another unit?")
        if len(self.grid.values_of("width_px")) > 1 and self.grid.fixed.get("fx_px") is not None:
            yield (f"fx_px is fixed while width_px varies: HFOV goes from {hfov}°; hfov_deg in "
                   "place of fx_px keeps it")
        yield from self._radians("camera")

    def _centre_notes(self) -> Iterator[str]:
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

    def _side_notes(self) -> Iterator[str]:
        """Yield a line if no marker of the grid is of a size that can be detected."""
        far, near = self.camera["side_px"] or (0.0, math.inf)
        units = "" if "side_px" in self.grid.given else (
            f"; size_m = {_text(self._numbers('size_m'))}: are it and the distances in metres?")
        if near < min(map(module_count, self.grid.values_of("dictionary"))):
            yield (f"{self._whose} at most {near:.4g} px, less than a pixel a module: too small to "
                   f"be read{units}")
        elif far > max(self.camera["width_px"][1], self.camera["height_px"][1]):
            yield f"{self._whose} at least {far:.4g} px, more than the frame's{units}"

    def _belief_notes(self) -> Iterator[str]:
        given, calibrated = self.grid.given, self.grid.calibration is not None
        for own, other in (("fx", "fy"), ("fy", "fx")):
            if f"believed_{own}_px" in given and f"believed_{other}_px" not in given:
                yield (f"believed_{own}_px alone: the {other} believed stays the true one; "
                       "believed_focal_scale is a focal length believed wrongly")
        for name in STATED:
            if name in given and not calibrated and self.grid.fixed.get("camera_file") is None:
                yield f"{name} has no effect: no estimator has believed = calibration"
        if calibrated and self.grid.fixed["calibration_sd"]:
            yield ("the calibration's numbers are drawn independently of each other; those of most "
                   "calibrations, fx and fy above all, vary together, which "
                   "calibration_covariance states")

    # The poses.

    @cached_property
    def _scenes(self) -> Scenes:
        """The scenes that are looked at."""
        count, values = self._sample
        return build_scenes(values, count)

    @cached_property
    def views(self) -> dict[str, Floats]:
        """Tilt to the image plane, angle to the line of sight, distance of the centre, (n,) each.

        Of the scenes that are looked at.
        """
        rotation, translation = self._scenes.rotation, self._scenes.translation
        return {
            "tilt_deg": np.degrees(angles_of_rotation(rotation)[0]),
            "viewing_angle_deg": np.degrees(viewing_angle(rotation, translation)),
            "range_m": np.linalg.norm(translation, axis=1),
        }

    @property
    def view_ranges(self) -> dict[str, list[float]]:
        """The least and the largest tilt, viewing angle and distance."""
        return {name: list(_ends(numbers)) for name, numbers in self.views.items()}

    @property
    def pose_line(self) -> str:
        """The poses in one line."""
        count, _ = self._sample
        tilt, angle, distance = (_text(numbers, 4) for numbers in self.views.values())
        sample = f" ({count:,} poses looked at)" * (count < len(self.experiment.all_scenes))
        return f"tilt {tilt}°, viewing angle {angle}°, {distance} m away{sample}"

    @cached_property
    def pose_notes(self) -> list[str]:
        """A line for each property of a pipeline's poses that may surprise."""
        return [*self._visibility_notes(), *self._axis_notes(), *self._radians("pose")]

    def _share(self, chosen: Masks) -> str:
        """Return the share of the poses that are ``chosen``, in words."""
        whole = len(chosen) >= len(self.experiment.all_scenes)
        if chosen.all():
            return "all poses" if whole else f"all {len(chosen):,} poses looked at"
        return f"{'' if whole else 'about '}{100 * chosen.mean():.2g} % of the poses"

    def _visibility_notes(self) -> Iterator[str]:
        """Yield a line for each reason for which markers are not wholly seen; the first counts."""
        scenes, target = self._scenes, self.grid.target_word
        within = f"; frame_x and frame_y place a {target} within it" * (
            self.grid.given.isdisjoint((*WORLD, "frame_x", "frame_y")))
        left = np.ones(len(scenes), dtype=bool)

        def outside() -> Masks:
            rows, wholly = np.flatnonzero(left), np.zeros_like(left)
            wholly[rows] = outside_frame(scenes, rows)
            return wholly

        corners = scenes.corners_px
        reasons: tuple[tuple[Callable[[], Any], str], ...] = (
            (lambda: ~np.isfinite(scenes.outline_px).all(axis=(1, 2)),
             "have a corner behind the camera: not_visible"),
            (lambda: hidden(scenes),
             f"show the {target}'s back or edge (a viewing angle of 90° or more): not_visible"),
            (lambda: not_modelled(scenes),
             "lie where the lens folds, or bend or move out of what is modelled: not_modelled"),
            (outside, f"are outside the frame: not_visible{within}"),
            (lambda: ((corners < -0.5) | (corners > scenes.frame[:, None, :] - 0.5)).any((1, 2)),
             "are cut off by the frame's edge"),
        )
        for reason, what in reasons:
            chosen = np.asarray(left & reason())
            left &= ~chosen
            if chosen.mean() > MIN_SHARE:
                yield f"{self._share(chosen)} {what}"

    def _axis_notes(self) -> Iterator[str]:
        """Yield lines for angles and distances that differ off the axis, or do nothing."""
        given, drawn = self.grid.given, self.grid.distributions
        shown, in_camera = self._scenes.translation[:, 2] > 0, given.isdisjoint(WORLD)
        tilt, view, distance = (numbers[shown] for numbers in self.views.values())
        apart = np.abs(view - tilt).max(initial=0)
        farther = (distance / self._scenes.translation[shown, 2]).max(initial=0)
        turned = "view_angle_deg" if "view_angle_deg" in given else "tilt_deg"
        if in_camera and turned == "tilt_deg" and apart > APART_DEG:
            angles = "tilt_deg is" if given.isdisjoint(("yaw_deg", "pitch_deg")) else (
                "yaw_deg and pitch_deg are")
            yield ("off the optical axis the viewing angle differs from the tilt by up to "
                   f"{apart:.3g}° (tilt {_text(tilt, 3)}°, viewing angle {_text(view, 3)}°): "
                   f"{angles} to the image plane, view_angle_deg is to the line of sight")
        if in_camera and farther > FARTHER:
            depth = "side_px" if "side_px" in given else "distance_m"
            yield (f"{depth} counts along the optical axis: off it, the "
                   f"{self.grid.target_word}'s centre is up to {farther:.3g} times as far away")
        if ("azimuth_deg" in drawn or len(self.grid.values_of("azimuth_deg")) > 1) and not (
                turned in drawn or self.grid.any_value(turned, bool)):
            yield f"azimuth_deg has no effect: it is the direction of a tilt, and {turned} is 0"

    # The detections, and all notes.

    @property
    def detector_notes(self) -> Iterator[str]:
        """A line for each property of the detections that may surprise."""
        squares = "aprilgrid" in self.grid.values_of("kind") or any(
            self.grid.values_of("corner_squares"))
        if squares and self.grid.given.isdisjoint(("adaptiveThreshConstant", "detector")):
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
        if PHOTOGRAPHS in self.grid.given:
            return []
        return [*self.camera_notes, *self.pose_notes, *self.detector_notes]

    @cached_property
    def parts(self) -> list[Part]:
        """Every optional part, active or not."""
        grid, effects, settings = self.grid, self.experiment.effects, self.experiment.detectors
        on = [effect for effect in effects
              if effect.switch in grid.distributions
              or grid.any_value(effect.switch, effect.is_on)]
        calibrated = grid.calibration is not None
        draws = dict.fromkeys([
            *grid.distributions, *["jitter_px"] * grid.any_value("jitter_px", bool),
            *(each.switch for each in on if each.random),
            *["the believed calibration"] * calibrated,
        ])
        lens = any(map(canonical_distortion, grid.values_of("distortion")))
        image = grid.any_value("background", lambda value: isinstance(value, str))
        noisy = any(effect.switch in draws for effect in effects if effect.widens == "noise")
        coarse = any("noise" in effect.worsens for effect in on)
        around = f" px around the {grid.target_word}'s pixels" + (
            f", and {NOISE_MARGIN_PX * (1 + coarse)} more for noise" if noisy else "")
        windows = {margin_px(each) for each in settings if full_frame_reason(each) is None}
        if image or "full" in grid.values_of("window"):
            windows = set()
        assumptions = [
            name for name in PARAMETERS
            if name.startswith("believed_") and grid.fixed.get(name, "varies") is not None
        ] + ["believed: calibration"] * calibrated
        with_pixels = {each.name for each in grid.plugins if each.needs_images} | {
            name for name, each in SOLVERS.items() if each.needs_images}
        # Why each is active, and what is said if nothing is a reason.
        reasons: dict[str, tuple[Iterable[str], str]] = {
            "lens distortion": (["distortion is given"] * lens, "distortion is empty"),
            "random draws": (
                [*draws, *["Sobol' points"] * (grid.sampling == "sobol")], "nothing is random"),
            "background image": (["background names a file"] * image, "a level"),
            "window": ([", ".join(map(str, sorted(windows))) + around] * bool(windows),
                       "the full frame"),
            "plug-ins": (map(_described, grid.plugins), "none is named"),
            "full frame": (self._reasons_for_the_frame(on, image=image), "no setting needs it"),
            "renderer": (sorted(set(grid.values_of("renderer"))), ""),
            "solver guard": (["guarded = true"] * grid.any_value("guarded", bool),
                             "guarded = false: plain cv2.solvePnP"),
            "accuracy bound": (
                [f"bound is {each}" for each in sorted(set(grid.values_of("bound")) - {"none"})],
                "bound is none"),
            "pixels kept": (
                [f"solver {each} needs them" for each in grid.values_of("solver")
                 if each in with_pixels], "no solver needs them"),
            "wrong assumptions": (assumptions, "the estimator knows the true camera and size"),
        }
        listed = [Part(name, bool(text := ", ".join(each)), text or otherwise)
                  for name, (each, otherwise) in reasons.items()]
        return [*listed, *map(self._effect, effects)]

    def _reasons_for_the_frame(self, on: Sequence[Effect], *, image: bool) -> list[str]:
        """Return why the whole frame is searched, given the effects that are on."""
        settings = self.experiment.detectors
        reasons = sorted({reason for each in settings if (reason := full_frame_reason(each))})
        gain = math.inf if any("uneven light" in effect.worsens for effect in on) else max(
            [1.0, *self.grid.values_of("gain")])
        if any(effect.widens == "uneven light" for effect in on) and any(
                uneven_light_needs_frame(setting, gain) for setting in settings):
            reasons.append("adaptiveThreshConstant is low for uneven light")
        if image:
            reasons.append("the background is an image: clutter near the "
                           f"{self.grid.target_word} may change the detection")
        return reasons + ['window = "full"'] * ("full" in self.grid.values_of("window"))

    def _effect(self, effect: Effect) -> Part:
        switch, drawn = effect.switch, self.grid.distributions.get(effect.switch)
        if drawn is not None:
            return Part(effect.label, True, f"{switch} is drawn: {drawn}", switch)
        values = [value for value in self.grid.values_of(switch) if effect.is_on(value)]
        text = ", ".join(dict.fromkeys(map(label, values))) if is_coded(effect.off) or not values \
            else _text(values)
        return Part(effect.label, bool(values), f"{switch} is {text or effect.off_text}", switch)


def _described(plugin: DeclaredPlugin) -> str:
    """Return a plug-in in words: kind, name, versions."""
    versions = ", ".join(f"{name} {version}" for name, version in plugin.versions)
    threads = f", {plugin.threads} threads" if plugin.threads > 1 else ""
    return f"{plugin.kind} {plugin.name}" + (f" ({versions})" if versions else "") + threads
