"""What a pipeline's camera and poses are, which parts are active, and what may surprise."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
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
from sweep.model.exposure import hidden, outside_frame
from sweep.model.lens import fold_radius
from sweep.model.marker import module_count
from sweep.model.pose import viewing_angle
from sweep.model.scene import build_cameras, build_scenes
from sweep.plugins.declared import DeclaredPlugin
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# What a pipeline's camera and poses are: ranges over the scenes that are looked at.

Range = tuple[float, float]
"""The least and the largest value on the grid."""


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """The camera of a grid; each quantity has its least and its largest value.

    Of large grids, and of what is drawn, by the scenes that are looked at.

    Attributes
    ----------
    width_px, height_px, fx_px, fy_px, cx_px, cy_px
        Frame, focal lengths and principal point.
    hfov_deg, vfov_deg
        Angle between the frame's edges, without lens distortion: 2 atan(width / (2 fx)).
    aspect
        fy / fx: the width of a pixel over its height.
    off_centre_x, off_centre_y
        Principal point minus the frame's centre, as a share of its width and height.
    square
        Whether the pixels are square everywhere on the grid.
    side_px
        Side of the black square parallel to the image plane, at the farthest and the nearest
        pose; None if all are behind the camera. Of boards the sides of the smallest and the
        largest marker.
    boards
        Whether scenes show boards.
    """

    width_px: Range
    height_px: Range
    fx_px: Range
    fy_px: Range
    cx_px: Range
    cy_px: Range
    hfov_deg: Range
    vfov_deg: Range
    aspect: Range
    off_centre_x: Range
    off_centre_y: Range
    square: bool
    side_px: Range | None
    boards: bool

    def line(self) -> str:
        """Return the camera in one line."""
        focal = f"fx = fy = {_text(self.fx_px)} px" if self.square else (
            f"fx = {_text(self.fx_px)} px, fy = {_text(self.fy_px)} px "
            f"(pixels are not square: fy/fx = {_text(self.aspect, 4)})")
        line = (f"{self.frame}, {focal}, HFOV {_text(self.hfov_deg, 4)}°, "
                f"VFOV {_text(self.vfov_deg, 4)}°")
        if self.side_px is None:
            return line
        if self.boards:
            return f"{line}, the markers have sides of {_text(self.side_px, 4)} px"
        far, near = self.side_px
        return f"{line}, the marker's side is " + (f"{far:.4g} px" if far == near else (
            f"{near:.4g} px at the nearest pose, {far:.4g} px at the farthest"))

    @property
    def frame(self) -> str:
        """The frame's size, in words."""
        return f"{_text(self.width_px)} x {_text(self.height_px)} px"

    def attributes(self) -> dict[str, Any]:
        """Return the dataset's attributes: a number, or the least and the largest one."""
        sides = {} if self.side_px is None else dict(
            zip(("farthest_side_px", "nearest_side_px"), self.side_px, strict=True))
        return {
            f"camera_{name}": low if low == high else [low, high]
            for name in ("fx_px", "fy_px", "hfov_deg", "vfov_deg")
            for low, high in [getattr(self, name)]
        } | sides


@dataclass(frozen=True, slots=True)
class PoseFacts:
    """Poses of a grid, all of them or a sample.

    Attributes
    ----------
    poses, sampled
        Scene cells of the grid, and how many of them were looked at.
    tilt_deg, viewing_angle_deg, range_m
        (n,) of each: angle to the image plane, angle to the line of sight, distance of the centre.
    depth_m
        (n,) of the centre, along the optical axis.
    behind, averted, outside, cut
        (n,) whether a corner is behind the camera; the marker is seen from behind or edge on; it
        lies outside the frame; a corner of the black square does. Each without those before.
    """

    poses: int
    sampled: int
    tilt_deg: Floats
    viewing_angle_deg: Floats
    range_m: Floats
    depth_m: Floats
    behind: Masks
    averted: Masks
    outside: Masks
    cut: Masks

    def line(self) -> str:
        """Return the poses in one line."""
        sample = "" if self.sampled == self.poses else f" ({self.sampled:,} poses looked at)"
        return (f"tilt {_text(self.tilt_deg, 4)}°, viewing angle "
                f"{_text(self.viewing_angle_deg, 4)}°, {_text(self.range_m, 4)} m away{sample}")

    def ranges(self) -> dict[str, list[float]]:
        """Return the least and the largest tilt, viewing angle and distance."""
        return {name: list(_ends(getattr(self, name)))
                for name in ("tilt_deg", "viewing_angle_deg", "range_m")}

    def share(self, chosen: Masks) -> str:
        """Return the share of the poses that are ``chosen``, in words."""
        count, whole = int(chosen.sum()), self.sampled == self.poses
        if count == self.sampled:
            return "all poses" if whole else f"all {count:,} poses looked at"
        return f"{'' if whole else 'about '}{100 * chosen.mean():.2g} % of the poses"


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


def _listed(name: str, values: Iterable[str], otherwise: str, form: str = "{}") -> Part:
    """Return a part that is active if there are values, which are its reason."""
    text = ", ".join(values)
    return Part(name, bool(text), form.format(text) if text else otherwise)


# --------------------------------------------------------------------------------------------------
# The facts of an experiment, and what may surprise: a line each. They are gathered once.

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

POLE = 1e-9
"""Denominator of the radial distortion at a fold below which it is a pole."""

NOT_SQUARE = 0.01
"""Difference of fy/fx from 1 that is told; calibrations of square pixels differ by less."""

APART_DEG = 5.0
"""Difference of tilt and viewing angle that is told."""

FARTHER = 1.1
"""Range over depth that is told: a direction of 25° from the optical axis."""

MIN_SHARE = 0.01
"""Share of poses that is told."""


class Facts:
    """What an experiment's camera and poses are, which parts are active, and what may surprise.

    `sweep plan` prints all of it; the start of a run prints the notes.
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
        cells = math.prod(lengths)
        if cells <= MAX_SAMPLE:
            indices = [index.ravel() for index in np.indices(lengths, dtype=np.intp)]
            return max(cells, 1), self.experiment.scene_values(indices)
        first = {*VIEW_PARAMETERS, "size_m", "distance_m", "side_px"}
        # The last axis of a product varies fastest.
        order = sorted(range(len(axes)), key=lambda k: not first.isdisjoint(axes[k].columns))
        ends = itertools.product(*((0, lengths[k] - 1) if lengths[k] > 1 else (0,) for k in order))
        corners = np.array(list(itertools.islice(ends, MAX_CORNERS)), dtype=np.intp)
        chosen = np.random.default_rng(0)
        anywhere = [chosen.integers(0, length, MAX_SAMPLE - len(corners)) for length in lengths]
        return MAX_SAMPLE, self.experiment.scene_values([
            np.concatenate([corners[:, order.index(k)], other]).astype(np.intp)
            for k, other in enumerate(anywhere)
        ])

    @cached_property
    def camera(self) -> CameraFacts:
        """What a pipeline's camera is, by the scenes that are looked at."""
        count, values = self._sample
        fx, fy, cx, cy = build_cameras(values, count).view.T
        width, height = (values[name].broadcast(count) for name in ("width_px", "height_px"))
        given = values["side_px"]
        with np.errstate(divide="ignore"):
            sides = given.broadcast(count) if not given.missing else (
                fx * values["size_m"].broadcast(count) / values["distance_m"].broadcast(count))
        sides = sides[sides > 0]  # before the camera
        relative = self.grid.relative_sizes
        return CameraFacts(
            **{name: _ends(numbers) for name, numbers in {
                "width_px": width, "height_px": height, "fx_px": fx, "fy_px": fy, "cx_px": cx,
                "cy_px": cy, "hfov_deg": field_of_view_deg(width, fx),
                "vfov_deg": field_of_view_deg(height, fy), "aspect": fy / fx,
                "off_centre_x": (cx - (width - 1) / 2) / width,
                "off_centre_y": (cy - (height - 1) / 2) / height,
            }.items()},
            square=bool(np.all(are_square(fx, fy))), boards=self.grid.shows_boards,
            side_px=None if not len(sides) else (
                float(sides.min()) * relative[0], float(sides.max()) * relative[1]),
        )

    @cached_property
    def poses(self) -> PoseFacts:
        """What a pipeline's poses are."""
        count, values = self._sample
        scenes = build_scenes(values, count)
        normal, depth = scenes.rotation[:, 2, 2], scenes.translation[:, 2]
        behind = np.asarray(~np.isfinite(scenes.outline_px).all(axis=(1, 2)))
        averted = hidden(scenes) & ~behind
        outside = np.zeros(count, dtype=bool)
        seen = np.flatnonzero(~behind & ~averted)
        outside[seen] = outside_frame(scenes, seen)
        corners = scenes.corners_px
        beyond = (corners < -0.5) | (corners > scenes.frame[:, None, :] - 0.5)
        return PoseFacts(
            poses=math.prod(len(axis) for axis in self.experiment.scene_axes),
            sampled=count,
            tilt_deg=np.degrees(np.arctan2(np.hypot(*scenes.rotation[:, :2, 2].T), -normal)),
            viewing_angle_deg=np.degrees(viewing_angle(scenes.rotation, scenes.translation)),
            range_m=np.linalg.norm(scenes.translation, axis=1),
            depth_m=depth,
            behind=behind, averted=averted, outside=outside,
            cut=np.asarray(beyond.any(axis=(1, 2)) & ~behind & ~averted & ~outside),
        )

    @property
    def notes(self) -> list[str]:
        """The lines that `sweep plan` and the start of a run print."""
        if PHOTOGRAPHS in self.grid.given:
            return []
        return [*self.camera_notes, *self.pose_notes, *self.detector_notes]

    @cached_property
    def camera_notes(self) -> list[str]:
        """A line for each property of the camera, or of beliefs about it, that may surprise."""
        return [*self._view_notes(), *self._centre_notes(), *self._fold_notes(),
                *self._side_notes(), *self._belief_notes()]

    @cached_property
    def pose_notes(self) -> list[str]:
        """A line for each property of a pipeline's poses that may surprise."""
        return [*self._visibility_notes(), *self._axis_notes(), *self._unit_notes()]

    def _numbers(self, name: str) -> list[float]:
        """Return the numbers of the document for a parameter: the ends or the mean of draws."""
        if (drawn := self.grid.distributions.get(name)) is not None:
            return [drawn.a, drawn.b] if drawn.kind == "uniform" else [drawn.a]
        return [float(value) for value in self.grid.values_of(name) if value is not None]

    def _view_notes(self) -> Iterator[str]:
        facts = self.camera
        hfov = _text(facts.hfov_deg, 4)
        if max(abs(ratio - 1) for ratio in facts.aspect) > NOT_SQUARE:
            yield (f"pixels are not square: fy/fx = {_text(facts.aspect, 4)}; a single side of the "
                   "sensor, or fx_px alone, makes them square")
        if facts.hfov_deg[1] > WIDE_DEG:
            yield (f"HFOV {hfov}°: hardly any pinhole camera is as wide; is a focal length in "
                   "another unit?")
        if len(self.grid.values_of("width_px")) > 1 and self.grid.fixed.get("fx_px") is not None:
            yield (f"fx_px is fixed while width_px varies: HFOV goes from {hfov}°; hfov_deg in "
                   "place of fx_px keeps it")
        for name in FIELDS_OF_VIEW:
            numbers = self._numbers(name)
            if numbers and min(numbers) > RADIANS[0] and max(numbers) < RADIANS[1]:
                yield _in_degrees(name, numbers)

    def _centre_notes(self) -> Iterator[str]:
        facts = self.camera
        for name, ends, shares in (
            ("cx_px", facts.cx_px, facts.off_centre_x), ("cy_px", facts.cy_px, facts.off_centre_y),
        ):
            off = max(map(abs, shares))
            if off > 0.5:
                yield f"{name} = {_text(ends)}: outside the frame of {facts.frame}"
            elif off > OFF_CENTRE:
                yield (f"{name} = {_text(ends)}: far from the centre of the frame of "
                       f"{facts.frame}; is it that of another frame size?")
        x, y = facts.width_px[0] / 2, facts.height_px[0] / 2
        if (facts.cx_px, facts.cy_px) == ((x, x), (y, y)):
            yield (f"cx_px = {x:g}, cy_px = {y:g}: half the frame; with pixel (0, 0) at the "
                   f"pixel's centre, as here, the middle is {x - 0.5:g}, {y - 0.5:g}: subtract 0.5 "
                   "if the program that gave them has its corner there "
                   "(pipelines/half_pixel/README.md)")

    def _fold_notes(self) -> Iterator[str]:
        """Yield a line if the only lens' radial distortion stops growing within the frame."""
        facts = self.camera
        lens = canonical_distortion(self.grid.fixed.get("distortion", ()))
        ends = (facts.width_px, facts.height_px, facts.fx_px, facts.fy_px, facts.cx_px, facts.cy_px)
        radius = fold_radius(lens) if lens else math.inf
        if any(low != high for low, high in ends) or not math.isfinite(radius):
            return
        width, height, fx, fy, cx, cy = (low for low, _ in ends)
        k1, k2, _, _, k3, k4, k5, k6 = (*lens, *[0.0] * 8)[:8]
        s = radius**2
        denominator = 1 + s * (k4 + s * (k5 + s * k6))
        if denominator <= POLE:
            return
        fold = radius * (1 + s * (k1 + s * (k2 + s * k3))) / denominator
        corner = math.hypot(
            max(cx + 0.5, width - 0.5 - cx) / fx, max(cy + 0.5, height - 0.5 - cy) / fy
        )
        if fold < corner:
            yield (f"the lens folds {fold * fx:.0f} px from the principal point, within the frame "
                   f"(corner: {corner * fx:.0f} px): poses beyond are not_modelled")

    def _side_notes(self) -> Iterator[str]:
        """Yield a line if no marker of the grid is of a size that can be detected."""
        facts = self.camera
        far, near = facts.side_px or (0.0, math.inf)
        whose = "the markers' sides are" if facts.boards else "the marker's side is"
        units = (
            "" if "side_px" in self.grid.given
            else "; are size_m and the distances in metres?" if "size_m" in self.grid.given
            else f"; size_m is not given: {self.grid.fixed['size_m']:g} m"
        )
        if near < min(map(module_count, self.grid.values_of("dictionary"))):
            yield (f"{whose} at most {near:.4g} px, less than a pixel a module: too small to be "
                   f"read{units}")
        elif far > max(facts.width_px[1], facts.height_px[1]):
            yield f"{whose} at least {far:.4g} px, more than the frame's{units}"

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

    def _visibility_notes(self) -> list[str]:
        facts, target = self.poses, self.grid.target_word
        world = not self.grid.given.isdisjoint(WORLD)
        framed = not self.grid.given.isdisjoint(("frame_x", "frame_y"))
        lines = [f"{facts.share(chosen)} {what}" for chosen, what in (
            (facts.behind, "have a corner behind the camera: not_visible"),
            (facts.averted,
             f"show the {target}'s back or edge (a viewing angle of 90° or more): not_visible"),
            (facts.outside, f"are outside the frame{' of the camera' * world}: not_visible"
             + ("" if world or framed else f"; frame_x and frame_y place a {target} within it")),
            (facts.cut, "are cut off by the frame's edge"
             + (f"; where the {target} is too large for the frame, frame_x and frame_y put it in "
                "the middle" if framed else "")),
        ) if chosen.mean() > MIN_SHARE]
        unseen = facts.behind | facts.averted | facts.outside
        whole = [f"{facts.share(unseen)} are not_visible:"]
        return whole + lines if unseen.all() and len(lines) > 1 else lines

    def _axis_notes(self) -> Iterator[str]:
        """Yield lines for angles and distances that differ off the axis, or do nothing."""
        facts, given, drawn = self.poses, self.grid.given, self.grid.distributions
        shown, in_camera = ~facts.behind, given.isdisjoint(WORLD)
        tilt, view = facts.tilt_deg[shown], facts.viewing_angle_deg[shown]
        apart = np.abs(view - tilt).max(initial=0)
        farther = (facts.range_m[shown] / facts.depth_m[shown]).max(initial=0)
        turned = "view_angle_deg" if "view_angle_deg" in given else "tilt_deg"
        if in_camera and turned == "tilt_deg" and apart > APART_DEG:
            angles = "tilt_deg is" if given.isdisjoint(("yaw_deg", "pitch_deg")) else (
                "yaw_deg and pitch_deg are")
            yield ("off the optical axis the viewing angle differs from the tilt by up to "
                   f"{apart:.3g}° (tilt {_text(tilt, 3)}°, viewing angle {_text(view, 3)}°): "
                   f"{angles} to the image plane, view_angle_deg is to the line of sight")
        if in_camera and farther > FARTHER:
            distance = "side_px" if "side_px" in given else "distance_m"
            yield (f"{distance} counts along the optical axis: off it, the "
                   f"{self.grid.target_word}'s centre is up to {farther:.3g} times as far away")
        if ("azimuth_deg" in drawn or len(self.grid.values_of("azimuth_deg")) > 1) and not (
                turned in drawn or self.grid.any_value(turned, bool)):
            yield f"azimuth_deg has no effect: it is the direction of a tilt, and {turned} is 0"

    def _unit_notes(self) -> Iterator[str]:
        """Yield a line for each angle whose values look like radians."""
        for parameter in PARAMETERS.values():
            if parameter.section != "pose" or parameter.unit != "degree":
                continue
            values = self._numbers(parameter.name)
            steps = np.array([value for value in values if value]) / (math.pi / 12)
            close = np.abs(steps - np.round(steps)) * (math.pi / 12) < ROUNDED_RAD
            if len(steps) > 0 and (close & (np.abs(steps) > 0.5) & (np.abs(steps) < 24.5)).all():
                yield _in_degrees(parameter.name, values)

    @property
    def detector_notes(self) -> list[str]:
        """A line for each property of the detections that may surprise."""
        lines = []
        squares = self.grid.any_value("kind", lambda kind: kind == "aprilgrid") or (
            self.grid.any_value("corner_squares", bool))
        if squares and self.grid.given.isdisjoint(("adaptiveThreshConstant", "detector")):
            lines.append(
                "board: squares touch its markers' corners, and OpenCV's default threshold joins "
                "both: it finds a third of sharp markers; adaptiveThreshConstant = 60, "
                "adaptiveThreshWinSizeMax = 33 and adaptiveThreshWinSizeStep = 4 find four in "
                "five (pipelines/boards/README.md)")
        if "apriltag" in self.grid.values_of("cornerRefinementMethod"):
            lines.append(
                "cornerRefinementMethod = apriltag: OpenCV's corners are 0.4 to 0.5 px right of "
                "and below those of its other refinements, and of its calibrations: half a pixel "
                "in position and direction (pipelines/half_pixel/README.md)")
        return lines

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
        guarded = grid.any_value("guarded", bool)
        whole = self._reasons_for_the_frame(on, image=image)
        noisy = any(effect.switch in draws for effect in effects if effect.widens == "noise")
        coarse = any("noise" in effect.worsens for effect in on)
        noise = f", and {NOISE_MARGIN_PX * (1 + coarse)} more for noise" if noisy else ""
        windows = {margin_px(each) for each in settings if full_frame_reason(each) is None}
        if image or "full" in grid.values_of("window"):
            windows = set()
        assumptions = [
            name for name in PARAMETERS
            if name.startswith("believed_") and grid.fixed.get(name, "varies") is not None
        ] + ["believed: calibration"] * calibrated
        return [
            Part("lens distortion", lens, "distortion is given" if lens else "distortion is empty"),
            _listed("random draws", draws, "nothing is random",
                    "{}, Sobol' points" if grid.sampling == "sobol" else "{}"),
            Part("background image", image, "background names a file" if image else "a level"),
            _listed("window", map(str, sorted(windows)), "the full frame",
                    f"{{}} px around the {grid.target_word}'s pixels{noise}"),
            _listed("plug-ins", map(_described, grid.plugins), "none is named"),
            Part("full frame", bool(whole), "; ".join(whole) or "no setting needs it"),
            Part("renderer", True, ", ".join(sorted(set(grid.values_of("renderer"))))),
            *map(self._effect, effects),
            Part("solver guard", guarded,
                 "guarded = true" if guarded else "guarded = false: plain cv2.solvePnP"),
            _listed("accuracy bound", sorted(set(grid.values_of("bound")) - {"none"}),
                    "bound is none", "bound is {}"),
            _listed("pixels kept", filter(self._needs_images, grid.values_of("solver")),
                    "no solver needs them", "solver {} needs them"),
            _listed("wrong assumptions", assumptions,
                    "the estimator knows the true camera and size"),
        ]

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
        values = [value for value in self.grid.values_of(switch) if effect.is_on(value)]
        extent = str(effect.off_text)
        if drawn is not None:
            return Part(effect.label, True, f"{switch} is drawn: {drawn}", switch)
        if values:
            extent = ", ".join(dict.fromkeys(map(label, values))) if is_coded(effect.off) else (
                _text(values))
        return Part(effect.label, bool(values), f"{switch} is {extent}", switch)

    def _needs_images(self, solver: str) -> bool:
        plugin = self.grid.plugin("estimator", solver)
        return SOLVERS[solver].needs_images if plugin is None else plugin.needs_images


def _in_degrees(name: str, numbers: Sequence[float]) -> str:
    largest = max(numbers, key=abs)
    return (f"{name} = {largest:g}: in degrees; {largest:g} radians would be "
            f"{math.degrees(largest):.4g}")


def _described(plugin: DeclaredPlugin) -> str:
    """Return a plug-in in words: kind, name, versions."""
    versions = ", ".join(f"{name} {version}" for name, version in plugin.versions)
    threads = f", {plugin.threads} threads" if plugin.threads > 1 else ""
    return f"{plugin.kind} {plugin.name}" + (f" ({versions})" if versions else "") + threads
