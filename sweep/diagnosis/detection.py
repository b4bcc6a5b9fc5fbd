"""The error of one detection: covariance, bias and probability of a flip at an estimated pose."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sweep.analysis.error_models import FRONTAL_DEG, differences, focal_size_of, hat_basis
from sweep.analysis.poses import bearing_of, sight_rotation, viewing_angle_of
from sweep.errors import DatasetError
from sweep.measure.flags import EstimateStatus, Flipped
from sweep.messages import to_json
from sweep.model.pose import rotation_of_vector, vector_of_rotation
from sweep.store.lifecycle import open_dataset
from sweep.typing import Floats, Masks

# `sweep.analysis.error_models` is of the truth's conditions and one error at a time, without flips:
# what a plan needs. Here conditions are those of the estimate, which is all that a user has, and
# the six errors go together, in a frame in which they do so in one way: z along the line of sight,
# x in the direction in which the estimated marker is tilted. What goes with the image instead,
# such as apriltag's corners, which are half a pixel off, moves and turns the pose as a turn of the
# camera would.

KNOTS = (7, 6)
"""Knots of ln(side) and of the viewing angle."""

AMBIGUITY_SHARES = (0.02, 0.4, 0.7, 0.85, 0.93, 0.98, 0.998)
"""Shares of the poses below the knots of the ambiguity: flips are where it is near 1."""

MIN_POSES = 2000
"""Solved poses from which on a model is made."""

MIN_PHOTOGRAPHED = 50
"""Poses in photographs from which on a factor of the covariance is known."""

MIN_AT_KNOT = 25.0
"""Poses (sum of hat functions) at each knot that is used, below which nothing is known there."""

ROUNDS = 6
"""Rounds in which covariances at knots are fitted to what the last ones leave unexplained."""

RIDGE = 0.05
"""Penalty on differences between neighbouring knots of the flips, in poses."""


@dataclass(frozen=True)
class DetectionModel:
    """Errors of one detection at its estimated pose; `error_model` makes it.

    Attributes
    ----------
    focal_size_px_m
        fx times the side of the square, px m.
    side_knots, angle_knots, ambiguity_knots
        Knots of ln(side, px), viewing angle (degrees) and ln(ambiguity).
    shift
        Median error (6,) of position over z and of rotation (rad) that goes with the image; 0 along
        and about z.
    bias
        Mean errors that go with the tilt (knots, 6): position over the range, and rotation (rad).
    log_covariance
        Matrix logarithms (knots, 6, 6) of their covariances.
    poses
        Solved poses at each knot (knots,).
    flips
        Coefficients (knots of all three,) of the logarithm of the odds of a flip.
    max_bearing_deg
        Largest angle to the optical axis that was seen.
    """

    focal_size_px_m: float
    side_knots: Floats
    angle_knots: Floats
    ambiguity_knots: Floats
    shift: Floats
    bias: Floats
    log_covariance: Floats
    poses: Floats
    flips: Floats
    max_bearing_deg: float

    def at(
        self, rvec: ArrayLike, tvec_m: ArrayLike, ambiguity: ArrayLike | None = None
    ) -> xr.Dataset:
        """Return covariance, bias and probability of a flip of estimated poses.

        Parameters
        ----------
        rvec, tvec_m
            Estimated rotation vectors and positions (n, 3).
        ambiguity
            Reprojection error of the chosen solution over that of the other one (n,), both of
            `cv2.solvePnPGeneric`; without it the flip's probability is that of the middle one.

        Returns
        -------
        xr.Dataset
            ``covariance`` (pose, row, column) and ``bias`` (pose, row) in the order x, y, z (m),
            rotation about x, y, z (rad), along and about the camera's axes: subtract the bias from
            the position, and turn back by it, before the covariance describes what is left, if the
            pose is not flipped. ``flip_probability``; ``known``: False, and all others NaN, where
            the simulation has too few poses.
        """
        rvec, tvec = (np.atleast_2d(np.asarray(each, dtype=np.float64)) for each in (rvec, tvec_m))
        frame, at = _conditions(rvec, tvec, self.focal_size_px_m)
        basis = hat_basis(at, [self.side_knots, self.angle_knots])
        knots = np.stack([(each[0], each[-1]) for each in (self.side_knots, self.angle_knots)])
        known = ((knots[:, 0] <= at) & (at <= knots[:, 1])).all(axis=1)
        known &= bearing_of(tvec) <= self.max_bearing_deg
        known &= ((basis > 0) <= (self.poses >= MIN_AT_KNOT)).all(axis=1)
        turn = np.zeros((len(tvec), 6, 6))
        turn[:, :3, :3] = frame * np.linalg.norm(tvec, axis=1)[:, None, None]
        turn[:, 3:, 3:] = frame
        covariance = turn @ _of_symmetric(
            np.einsum("nk,kij->nij", basis, self.log_covariance), np.exp) @ turn.transpose(0, 2, 1)
        bias = np.einsum("nij,nj->ni", turn, basis @ self.bias)
        bias += self.shift * np.repeat([tvec[:, 2], np.ones(len(tvec))], 3, axis=0).T
        middle = math.exp(float(np.median(self.ambiguity_knots)))
        ratio = np.broadcast_to(
            np.asarray(middle if ambiguity is None else ambiguity, dtype=np.float64), len(tvec))
        odds = _flip_basis(at, ratio, self.flip_knots) @ self.flips
        unknown = ~known
        for values in (covariance, bias, odds):
            values[unknown] = np.nan
        return xr.Dataset({
            "covariance": (("pose", "row", "column"), covariance, {"units": "m2, m rad, rad2"}),
            "bias": (("pose", "row"), bias, {"units": "m, radian"}),
            "flip_probability": ("pose", 1.0 / (1.0 + np.exp(-odds)), {"units": "1"}),
            "known": ("pose", known)})

    @property
    def flip_knots(self) -> list[Floats]:
        """Knots of ambiguity, side and viewing angle of the flips."""
        return [self.ambiguity_knots, self.side_knots[::3], self.angle_knots[[0, 2, 5]]]

    def to_json(self) -> str:
        """Return it as a JSON object: its attributes."""
        return to_json(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> DetectionModel:
        """Return the model of `to_json`."""
        values: dict[str, Any] = {
            name: np.array(value) if isinstance(value, list) else value
            for name, value in json.loads(text).items()}
        return cls(**values)


def error_model(
    store: xr.Dataset | str | os.PathLike[str],
    photographs: xr.Dataset | str | os.PathLike[str] | None = None,
) -> DetectionModel:
    """Make a model of the error of one detection: covariance, bias, probability of a flip.

    Parameters
    ----------
    store
        A simulation of one detector setting and one solver, with drawn poses: its path, or results
        of `open`, of which one setting was chosen with ``.isel``.
    photographs
        A store of `photos` with the same setting and solver, or its results: the covariance is
        multiplied by a factor, so that it describes their errors. Judge it on others.

    Returns
    -------
    DetectionModel
        ``model.at(rvec, tvec_m, ambiguity)`` has the 6 x 6 covariance, the bias and the probability
        of a flip of estimated poses, and whether they are known: the simulation has poses there.
        ``model.to_json()`` keeps it.

    Raises
    ------
    StoreError, DatasetError
        If there is no store, fewer than 2,000 solved poses or 50 of photographs, or several
        settings.

    Examples
    --------
    >>> drawn = sweep.run({
    ...     "pose": {"side_px": {"uniform": [40, 80]}, "tilt_deg": {"uniform": [0, 60]},
    ...              "azimuth_deg": {"uniform": [0, 360]}, "jitter_px": 0.5},
    ...     "scene": {"noise_grey": 2.0}, "axes": {"trial": 2200},
    ... }, store=folder / "drawn.zarr")
    >>> error_model = sweep.error_model(folder / "drawn.zarr")
    >>> at = error_model.at(drawn.true_rvec[:3], drawn.true_tvec_m[:3])  # (3, 3) each
    >>> at.covariance.shape, at.covariance.dims
    ((3, 6, 6), ('pose', 'row', 'column'))
    """
    model = of_simulation(_opened(store))
    return model if photographs is None else widened(model, _opened(photographs))


def _opened(store: xr.Dataset | str | os.PathLike[str]) -> xr.Dataset:
    return store if isinstance(store, xr.Dataset) else open_dataset(os.fspath(store))


def widened(model: DetectionModel, photographs: xr.Dataset) -> DetectionModel:
    """Return a model whose covariance times a factor describes the errors in photographs."""
    found = judged(model, photographs)
    used = np.isfinite(found["squared_error"].values)
    if used.sum() < MIN_PHOTOGRAPHED:
        raise DatasetError(
            f"{used.sum()} solved poses of photographs that are not flipped and that the "
            f"simulation knows: a factor needs {MIN_PHOTOGRAPHED} or more; take more photographs, "
            "or simulate their poses (`sweep.twins`)")
    error, covariance, deviations = (
        found[name].values[used] for name in ("error", "covariance", "truth_std"))
    factor = 1.0
    for _ in range(ROUNDS):  # the truth's own errors are not multiplied
        factor *= float(squared_errors(error, factor * covariance, deviations).mean()) / 6.0
    return dataclasses.replace(
        model, log_covariance=model.log_covariance + math.log(factor) * np.eye(6))


def squared_errors(errors: Floats, covariance: Floats, deviations: Floats) -> Floats:
    """Return squares (n,) of errors (n, 6) in units of a covariance and of the truth's own one."""
    both = covariance + np.eye(6) * deviations[:, None, :] ** 2
    return np.asarray(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(both), errors))


def judged(model: DetectionModel, results: xr.Dataset) -> xr.Dataset:
    """Return what a model says of the solved poses of a dataset, beside their errors.

    Returns
    -------
    xr.Dataset
        As `DetectionModel.at`, and ``error`` (pose, row): estimated minus true, less the bias;
        ``truth_std`` (pose, row), 0 where it is not known; ``flipped``; ``squared_error``: the
        error's square in units of both covariances, 6 on average where these are right, NaN of
        flipped poses and where nothing is known.
    """
    errors, rvec, tvec, ratio, flipped, deviations = estimated(results)
    found = model.at(rvec, tvec, ratio)
    lengths = np.linalg.norm(tvec, axis=1)
    left = errors * np.repeat([lengths, np.ones(len(tvec))], 3, axis=0).T - found["bias"].values
    squares = np.full(len(left), np.nan)
    used = found["known"].values & ~flipped
    squares[used] = squared_errors(
        left[used], found["covariance"].values[used], deviations[used])
    return found.assign(
        error=(("pose", "row"), left), truth_std=(("pose", "row"), deviations),
        flipped=("pose", flipped), squared_error=("pose", squares))


def of_simulation(results: xr.Dataset) -> DetectionModel:
    """Return the model of a simulation's poses."""
    errors, rvec, tvec, ratio, flipped, _ = estimated(results)
    if len(tvec) < MIN_POSES:
        raise DatasetError(f"{len(tvec):,} solved poses; a model of one detection needs "
                           f"{MIN_POSES:,} or more: more trials")
    focal_size = float(focal_size_of(results).mean())
    frame, at = _conditions(rvec, tvec, focal_size)
    right = ~flipped
    slant = tvec[:, 2] / np.linalg.norm(tvec, axis=1)
    per_z = np.repeat([slant, np.ones(len(tvec))], 3, axis=0).T
    # Across the line of sight, where errors are small: those along it would hide the shift.
    across = sight_rotation(tvec).transpose(0, 2, 1)[:, :2]
    moved = np.linalg.solve(across[:, :, :2] * slant[:, None, None],
                            across @ errors[:, :3, None])[..., 0]
    shift = np.zeros(6)
    shift[[0, 1, 3, 4]] = np.median(np.concatenate([moved, errors[:, 3:5]], axis=1)[right], axis=0)
    errors -= shift * per_z
    errors = np.einsum("nji,nkj->nki", frame, errors.reshape(-1, 2, 3)).reshape(-1, 6)
    side, angle = (np.quantile(at[:, k], np.linspace(0.0, 1.0, KNOTS[k])) for k in (0, 1))
    angle[0] = 0.0 if angle[0] < FRONTAL_DEG else angle[0]
    basis, errors = hat_basis(at[right], [side, angle]), errors[right]
    poses = basis.sum(axis=0)

    def means(values: Floats) -> Floats:
        """Return the means of values (n, ...) at the knots; those of few poses are held back."""
        flat = values.reshape(len(values), -1)
        near = (basis.T @ flat + flat.mean(axis=0)) / (poses + 1.0)[:, None]
        return np.asarray(near.reshape(-1, *values.shape[1:]))

    log_covariance = np.log(means((errors - basis @ means(errors)) ** 2))[..., None] * np.eye(6)
    for _ in range(ROUNDS):
        spread = np.exp(0.5 * basis @ np.diagonal(log_covariance, axis1=1, axis2=2))
        bias = np.stack([
            np.linalg.solve((basis.T / sd**2) @ basis + np.eye(len(poses)) * (1e-3 / sd**2).mean(),
                            (basis.T / sd**2) @ error)
            for error, sd in zip(errors.T, spread.T, strict=True)], axis=-1)
        whitened = np.einsum("nij,nj->ni", _of_symmetric(
            -0.5 * np.einsum("nk,kij->nij", basis, log_covariance), np.exp), errors - basis @ bias)
        root = _of_symmetric(0.5 * log_covariance, np.exp)
        log_covariance = _of_symmetric(
            root @ means(whitened[:, :, None] * whitened[:, None, :]) @ root, np.log)
    # Inverses of covariances of n poses are too large by n / (n - 7) on average (Anderson, "An
    # introduction to multivariate statistical analysis", 2003, section 7.7), and the means' errors
    # add 1 / n. Heavy tails are worth fewer normal poses: n over Mardia's kurtosis / 48.
    tails = max(float(((whitened**2).sum(axis=1) ** 2).mean()) / 48.0, 1.0)
    wider = np.log((poses + tails) / np.maximum(poses - 7.0 * tails, 0.5 * poses + 1.0))
    log_covariance = log_covariance + wider[:, None, None] * np.eye(6)
    ambiguity = np.quantile(np.log(ratio[ratio > 0]), AMBIGUITY_SHARES)
    model = DetectionModel(
        focal_size, side, angle, ambiguity, shift, bias, log_covariance, poses, np.zeros(0),
        float(bearing_of(tvec).max()))
    return dataclasses.replace(model, flips=_flip_fit(at, ratio, flipped, model.flip_knots))


def estimated(results: xr.Dataset) -> tuple[Floats, Floats, Floats, Floats, Masks, Floats]:
    """Return errors (n, 6) of solved poses, estimates, ambiguity, flips, and errors of the truth.

    Errors are along and about the camera's axes, those of positions over the estimated range; the
    truth's standard deviations (n, 6), in metres and radians, are 0 where they are not known.

    Raises
    ------
    DatasetError
        If there are several settings or solvers, or other variables are missing.
    """
    names = ("true_rvec", "true_tvec_m", "rotation_error_rad", "translation_error_m",
             "reprojection_error_px", "alternative_reprojection_error_px", "flipped", "estimate")
    if missing := [name for name in names if name not in results]:
        raise DatasetError(f"no variable {missing[0]}: expected a run that solves poses")
    scene = results["true_tvec_m"].dims
    if several := [f"{name} ({results.sizes[name]})" for name in results["estimate"].dims
                   if name not in scene and results.sizes[name] > 1]:
        raise DatasetError(f"several settings: {', '.join(map(str, several))}: choose one with "
                           "results.isel(...)")
    one = {dim: 0 for dim in results["estimate"].dims if dim not in scene}
    poses = [dim for dim in scene if dim != "xyz"]
    own = ["truth_std"] if "truth_std" in results else []
    table = results[[*names, *own]].isel(one, drop=True).load().stack(
        pose=poses, create_index=False)
    used = (table["estimate"] == EstimateStatus.solved).values
    deviations = np.zeros((used.sum(), 6))
    if own:  # rotation, then position
        stored = np.nan_to_num(table["truth_std"].transpose("pose", ...).values[used])
        deviations = stored[:, [3, 4, 5, 0, 1, 2]].astype(np.float64)
    rvec, tvec, rotation, position = (
        table[name].transpose("pose", "xyz").values[used].astype(np.float64) for name in names[:4])
    chosen, other, flipped = (table[name].values[used] for name in names[4:7])
    estimate = tvec + position
    turned = vector_of_rotation(rotation_of_vector(rotation) @ rotation_of_vector(rvec))
    errors = np.concatenate(
        [position / np.linalg.norm(estimate, axis=1)[:, None], rotation], axis=1)
    known = np.isfinite(other) & (other > 0)  # a solver may return one solution alone
    ratio = np.divide(chosen, other, out=np.zeros(len(other)), where=known)
    return errors, turned, estimate, ratio, flipped == Flipped.flipped, deviations


def _conditions(rvec: Floats, tvec: Floats, focal_size: float) -> tuple[Floats, Floats]:
    """Return the frames (n, 3, 3) of estimates, and ln(side) and viewing angle (n, 2)."""
    sight = sight_rotation(tvec)
    normal = np.einsum("nji,nj->ni", sight, rotation_of_vector(rvec)[..., 2])
    length = np.maximum(np.hypot(normal[:, 0], normal[:, 1]), 1e-12)
    cosine, sine = normal[:, 0] / length, normal[:, 1] / length
    nothing, one = np.zeros_like(cosine), np.ones_like(cosine)
    about = np.stack([np.stack(row, axis=-1) for row in (
        (cosine, -sine, nothing), (sine, cosine, nothing), (nothing, nothing, one))], axis=-2)
    return sight @ about, np.stack(
        [np.log(focal_size / tvec[:, 2]), viewing_angle_of(rvec, tvec)], axis=-1)


def _of_symmetric(matrices: Floats, function: Callable[[Floats], Floats]) -> Floats:
    """Return a function of symmetric matrices (n, m, m), such as their exponentials."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * function(values)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _flip_basis(at: Floats, ratio: Floats, knots: Sequence[Floats]) -> Floats:
    """Return hat functions (n, knots) of ambiguity, side and viewing angle."""
    with np.errstate(divide="ignore"):
        return hat_basis(np.column_stack([np.log(ratio), at]), knots)


def _flip_fit(at: Floats, ratio: Floats, flipped: Masks, knots: Sequence[Floats]) -> Floats:
    """Return the coefficients of a logistic regression, by iterated weighted least squares."""
    basis = _flip_basis(at, ratio, knots)
    ridge = RIDGE * differences(knots) + 1e-3 * np.eye(basis.shape[1])
    share = (flipped.sum() + 0.5) / (len(flipped) + 1.0)
    start = np.full(basis.shape[1], math.log(share / (1.0 - share)))
    found = start
    for _ in range(30):
        chance = 1.0 / (1.0 + np.exp(-(basis @ found)))
        slope = basis.T @ (flipped - chance) - ridge @ (found - start)
        curve = (basis * (chance * (1.0 - chance))[:, None]).T @ basis + ridge
        found = found + np.clip(np.linalg.solve(curve, slope), -2.0, 2.0)
    return found
