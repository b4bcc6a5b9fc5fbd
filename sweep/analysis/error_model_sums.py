"""Streamed sums for error models: moments of errors in bins, and how many lie within two sigma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.aggregate import aggregate
from sweep.analysis.dimensions import DRAWS
from sweep.analysis.error_model_fit import POWERS, BinSums, hat_basis
from sweep.analysis.pose_view import DEPTH, SIGNED_INPUTS, Poses, pose_arrays
from sweep.analysis.sight_frame import in_sight_frame, sight_rotation, viewing_angle_of
from sweep.analysis.states import BlockState
from sweep.analysis.statistic import Output, SinglePass, Variables
from sweep.typing import Floats, Integers

QUANTITIES = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
"""Errors in the sight frame: of the position (m), and the rotation vector (rad)."""

HALVES = 2
"""The even trials and the odd ones."""

MODEL, HALF, FOCAL_SIZE = "model", "half", "focal_size"
"""Names of a block's arrays: the number of the model, the half, fx times the marker's side."""

COUNTS = ("looked_for", "solved", "flipped", "judged")
"""Columns of `Coverage` before the shares."""


@dataclass(frozen=True)
class Bins:
    """Edges of the bins of distance (m), side (px) and viewing angle (degrees).

    A value at the last edge belongs to the last bin.
    """

    distance_m: Floats
    side_px: Floats
    viewing_angle_deg: Floats

    @property
    def edges(self) -> tuple[Floats, Floats, Floats]:
        """The edges of all three."""
        return self.distance_m, self.side_px, self.viewing_angle_deg

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of bins."""
        return tuple(len(each) - 1 for each in self.edges)

    def numbers(self, *values: Floats) -> tuple[Integers, NDArray[np.bool_]]:
        """Return the flat numbers of the bins of points, and which points are in a bin."""
        inside = np.ones(values[0].shape, dtype=bool)
        flat = np.zeros(values[0].shape, dtype=np.int64)
        for each, edges in zip(values, self.edges, strict=True):
            number = np.searchsorted(edges, each, side="right") - 1
            number = np.where(each == edges[-1], len(edges) - 2, number)
            inside &= (number >= 0) & (number < len(edges) - 1)
            flat = flat * (len(edges) - 1) + np.clip(number, 0, len(edges) - 2)
        return flat, inside


class SightErrors(Poses):
    """Poses with their errors in the sight frame."""

    @cached_property
    def distance_m(self) -> Floats:
        """True z of the marker's centre (...)."""
        return np.asarray(self[DEPTH], dtype=np.float64)

    @cached_property
    def side_px(self) -> Floats:
        """The black square's side (...), were it parallel to the image: fx · size / distance."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self[FOCAL_SIZE] / self.distance_m, dtype=np.float64)

    @cached_property
    def viewing_angle_deg(self) -> Floats:
        """Angle (...) between the marker's normal and the line of sight."""
        return viewing_angle_of(self["true_rvec"], self["true_tvec_m"])

    @cached_property
    def in_camera(self) -> Floats:
        """Errors (..., 6) along and about the camera's axes; positions over the distance."""
        position = self["translation_error_m"].astype(np.float64) / self.distance_m[..., None]
        return np.concatenate(
            [position, self["rotation_error_rad"].astype(np.float64)], axis=-1)

    @cached_property
    def in_sight(self) -> Floats:
        """The same in the sight frame."""
        parts = (self.in_camera[..., :3], self.in_camera[..., 3:])
        return np.concatenate(
            [in_sight_frame(part, self["true_tvec_m"]) for part in parts], axis=-1)

    def at(self, used: NDArray[np.bool_]) -> Floats:
        """Return ln(distance), ln(side) and viewing angle of the used poses, (n, 3)."""
        shape = used.shape
        distance, side, angle = (
            np.broadcast_to(each, shape)[used]
            for each in (self.distance_m, self.side_px, self.viewing_angle_deg))
        return np.stack([np.log(distance), np.log(side), angle], axis=-1)


@dataclass(frozen=True)
class Sums(BlockState["Sums"]):
    """Sums (groups, halves, bins, columns)."""

    values: Floats

    def fold(self) -> Sums:
        """Return itself."""
        return self


@dataclass(frozen=True)
class _OfBins(SinglePass[SightErrors, Sums]):
    """A statistic of a single variable, whose value is the array (halves, bins, columns)."""

    bins: Bins

    def outputs(self) -> Sequence[Output]:
        """Return the variable."""
        return [Output("sums", "sums over bins", "1", "O")]

    def result(self, state: Sums) -> Variables:
        """Return an array a group."""
        values = np.empty(len(state.values), dtype=object)
        for group, each in enumerate(state.values):
            values[group] = each
        return {"sums": values}

    def _add(self, at: Integers, groups: int, columns: Sequence[Any]) -> Floats:
        """Return the sums (groups, halves, bins, columns) of values at flat numbers."""
        size = groups * HALVES * int(np.prod(self.bins.shape))
        sums = [np.bincount(at, weights=each, minlength=size) for each in columns]
        return np.stack(sums, axis=-1).reshape(groups, HALVES, -1, len(columns)).astype(float)

    def _numbers(self, poses: SightErrors) -> tuple[Integers, NDArray[np.bool_]]:
        """Return the flat number of each pose's group, half and bin, and which have one."""
        bins, inside = self.bins.numbers(
            poses.distance_m, poses.side_px, poses.viewing_angle_deg)
        groups = np.arange(len(poses.detection)).reshape(-1, 1, 1, 1)
        flat = (groups * HALVES + poses[HALF]) * int(np.prod(self.bins.shape)) + bins
        numbers, counted = np.broadcast_arrays(flat, inside & poses.looked_for)
        return numbers, counted


@dataclass(frozen=True)
class BinMoments(_OfBins):
    """Number of poses, sums of their coordinates and of the powers of each error."""

    def first_pass(self, poses: SightErrors) -> Sums:
        """Sum over a block."""
        numbers, inside = self._numbers(poses)
        groups, used = len(poses.detection), inside & poses.unflipped
        errors = np.broadcast_to(poses.in_sight, (*numbers.shape, len(QUANTITIES)))[used]
        columns = [np.ones(len(errors)), *poses.at(used).T]
        for k in range(len(QUANTITIES)):
            power = np.ones(len(errors))
            for _ in range(POWERS):
                power = power * errors[:, k]
                columns.append(power)
        return Sums(self._add(numbers[used], groups, columns))


@dataclass(frozen=True)
class Moments:
    """What `BinMoments` gives of one model: arrays (halves, bins, columns)."""

    values: Floats

    def of(self, quantity: int, half: int | None = None) -> BinSums:
        """Return the sums of an error, of one half of the trials or of all."""
        values = self.values.sum(axis=0) if half is None else self.values[half]
        count = values[:, 0]
        at = values[:, 1:4] / np.maximum(count, 1.0)[:, None]
        start = 4 + POWERS * quantity
        return BinSums(count, at, values[:, start : start + POWERS]).filled()


    def along(self, axis: int, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Return, of the bins along an axis, the poses and the sum of that coordinate."""
        columns = self.values.sum(axis=0)[:, [0, 1 + axis]].reshape(*shape, 2)
        count, total = np.moveaxis(
            columns.sum(axis=tuple(k for k in range(len(shape)) if k != axis)), -1, 0)
        return count, total


@dataclass(frozen=True)
class Fitted:
    """The model of each half, by which the other is judged.

    ``bias`` and ``log_variance`` are (models, halves, knots, quantities), in the unit of
    `SightErrors.in_sight`.
    """

    knots: Sequence[Floats]
    bias: Floats
    log_variance: Floats


@dataclass(frozen=True)
class Coverage(_OfBins):
    """How many errors lie within two standard deviations of the bias, by a model of other draws.

    Columns: `COUNTS`; those within, for each error in the sight frame; the same along and about the
    camera's axes.
    """

    fitted: Fitted = field(repr=False)

    def first_pass(self, poses: SightErrors) -> Sums:
        """Count in a block."""
        numbers, inside = self._numbers(poses)
        shape = numbers.shape
        used = inside & poses.unflipped
        model, half = (np.broadcast_to(poses[name], shape)[used] for name in (MODEL, HALF))
        basis = hat_basis(poses.at(used), self.fitted.knots)
        other = 1 - half  # judged by the model of the other half
        bias, log_variance = (
            np.einsum("nk,nkq->nq", basis, each[model, other])
            for each in (self.fitted.bias, self.fitted.log_variance))
        sigma = np.exp(0.5 * log_variance)
        size = (*shape, len(QUANTITIES))
        sight = np.broadcast_to(poses.in_sight, size)[used]
        camera = np.broadcast_to(poses.in_camera, size)[used]
        turn = sight_rotation(np.broadcast_to(poses["true_tvec_m"], (*shape, 3))[used])
        columns = list((np.abs(sight - bias) <= 2.0 * sigma).T.astype(float))
        for part in (slice(0, 3), slice(3, 6)):
            mean = np.einsum("nij,nj->ni", turn, bias[:, part])
            spread = np.sqrt(np.einsum("nij,nj->ni", turn**2, sigma[:, part] ** 2))
            columns += list(
                (np.abs(camera[:, part] - mean) <= 2.0 * spread).T.astype(float))
        groups = len(poses.detection)
        counts = self._add(np.ravel(numbers), groups, [
            np.ravel(np.broadcast_to(each, shape) & inside).astype(float)
            for each in (poses.looked_for, poses.solved, poses.flipped, poses.unflipped)])
        within = self._add(numbers[used], groups, columns)
        return Sums(np.concatenate([counts, within], axis=-1))


def sums_of(
    results: xr.Dataset, kept: Sequence[str], focal_size: xr.DataArray, statistic: _OfBins
) -> list[Floats]:
    """Return the sums (halves, bins, columns) of each model, in the order of the kept axes."""
    sizes = [results.sizes[name] for name in kept]
    half = np.asarray(results[DRAWS].values) % HALVES
    inputs: Mapping[str, xr.DataArray] = pose_arrays(results, SIGNED_INPUTS) | {
        MODEL: xr.DataArray(np.arange(int(np.prod(sizes))).reshape(sizes), dims=tuple(kept)),
        HALF: xr.DataArray(half.astype(np.int64), dims=DRAWS),
        FOCAL_SIZE: focal_size,
    }
    table = aggregate(results, inputs, kept, [statistic], SightErrors).compute()
    return list(table["sums"].transpose(*kept).values.ravel())
