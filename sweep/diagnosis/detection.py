"""The error of one detection: covariance, bias and probability of a flip at an estimated pose."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sweep.analysis.dataset import bearing_of, focal_size_of, sight_rotation, viewing_angle_of
from sweep.analysis.error_models import FRONTAL_DEG, differences, hat_basis, rows_of
from sweep.errors import DatasetError
from sweep.measure.flags import EstimateStatus, Flipped
from sweep.model.pose import rotation_of_vector, vector_of_rotation
from sweep.report.table import to_json
from sweep.store.lifecycle import open_dataset
from sweep.typing import Floats, Masks

# `sweep.analysis.error_models` is of the truth's conditions and one error at a time, without flips:
# what a plan needs. Here conditions are those of the estimate, which is all that a user has, and
# the six errors go together, in a frame in which they do so in one way: z along the line of sight,
# x in the direction in which the estimated marker is tilted. What goes with the image instead,
# such as apriltag's corners, which are half a pixel off, moves and turns the pose as a turn of the
# camera would.

# Knots of ln(side) and of the viewing angle.
KNOTS = (7, 6)

# Shares of the poses below the knots of the ambiguity: flips are where it is near 1.
AMBIGUITY_SHARES = (0.02, 0.4, 0.7, 0.85, 0.93, 0.98, 0.998)

# Numbers of poses beyond which they are none: m, radian.
MOST = 1e6

# Solved poses from which on a model is made.
MIN_POSES = 2000

# Poses in photographs from which on a factor of the covariance is known.
MIN_PHOTOGRAPHED = 50

# Poses (sum of hat functions) at each knot that is used, below which nothing is known there.
MIN_AT_KNOT = 25.0

# Rounds in which covariances at knots are fitted to what the last ones leave unexplained.
ROUNDS = 6

# Penalty on differences between neighbouring knots of the flips, in poses.
RIDGE = 0.05


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
            Where it is NaN, below 0 or above 1 and all that were seen, nothing is known.

        Returns
        -------
        xr.Dataset
            ``covariance`` (pose, row, column) and ``bias`` (pose, row) in the order x, y, z (m),
            rotation about x, y, z (rad), along and about the camera's axes: subtract the bias from
            the position, and turn back by it, before the covariance describes what is left, if the
            pose is not flipped. ``flip_probability``; ``known``: False, and all others NaN, where
            the simulation has too few poses, and for poses that cannot be (NaN, behind the camera).
            A pose does not show which camera, dictionary, refinement and light it comes from: the
            model is of those that were simulated alone.

        Raises
        ------
        ArgumentError
            If one is no array of numbers of its shape, or of another number of poses.
        """
        middle = math.exp(float(np.median(self.ambiguity_knots)))
        rvec, tvec, ratio = rows_of(rvec=(rvec, 3), tvec_m=(tvec_m, 3), ambiguity=(
            middle if ambiguity is None else ambiguity, 1))
        # Of what no solver returns nothing is known, and the others are not disturbed by it.
        known = (np.abs(np.hstack([rvec, tvec])) < MOST).all(axis=1) & (tvec[:, 2] > 0)
        known &= (ratio >= 0) & (ratio <= max(1.0, math.exp(self.ambiguity_knots[-1])))
        rvec, tvec = (np.where(known[:, None], each, [0.0, 0.0, 1.0]) for each in (rvec, tvec))
        turn, at = frames(rvec, tvec), _conditions(rvec, tvec, ratio, self.focal_size_px_m)
        basis = hat_basis(at[:, 1:], [self.side_knots, self.angle_knots])
        first, last = ([self.side_knots[k], self.angle_knots[k]] for k in (0, -1))
        known &= ((at[:, 1:] >= first) & (at[:, 1:] <= last)).all(axis=1)
        known &= bearing_of(tvec) <= self.max_bearing_deg
        known &= ((basis > 0) <= (self.poses >= MIN_AT_KNOT)).all(axis=1)
        covariance = turn @ _of_symmetric(
            np.einsum("nk,kij->nij", basis, self.log_covariance), np.exp) @ turn.transpose(0, 2, 1)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        bias = np.einsum("nij,nj->ni", turn, basis @ self.bias) + self.shift * _lengths(tvec[:, 2])
        odds = hat_basis(at, self.flip_knots) @ self.flips
        return xr.Dataset({
            "covariance": (("pose", "row", "column"), covariance, {"units": "m2, m rad, rad2"}),
            "bias": (("pose", "row"), bias, {"units": "m, radian"}),
            "flip_probability": ("pose", 1.0 / (1.0 + np.exp(-odds)), {"units": "1"}),
        }).where(xr.DataArray(known, dims="pose")).assign(known=("pose", known))

    @property
    def flip_knots(self) -> list[Floats]:
        """Knots of ambiguity, side and viewing angle of the flips."""
        return [self.ambiguity_knots, self.side_knots[::3], self.angle_knots[[0, 2, 5]]]

    def to_json(self) -> str:
        """Return it as a JSON object: its attributes."""
        return to_json(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> DetectionModel:
        """Return the model of `to_json`.

        Raises
        ------
        DatasetError
            If there are other attributes or shapes, numbers that are not finite, a focal size that
            is not above 0, or knots that decrease.
        """
        try:
            model = cls(**json.loads(text, object_hook=lambda attributes: {
                name: np.array(value, np.float64)[()] for name, value in attributes.items()}))
            values, k = [*vars(model).values()], math.prod(KNOTS)
            shapes = [(), *((n,) for n in (*KNOTS, len(AMBIGUITY_SHARES), 6)), (k, 6), (k, 6, 6),
                      (k,), (math.prod(map(len, model.flip_knots)),), ()]
            right = [np.shape(value) for value in values] == shapes and model.focal_size_px_m > 0
            right &= all(np.isfinite(value).all() for value in values)
            right &= all((np.diff(knots) >= 0).all() for knots in values[1:4])
        except (TypeError, ValueError, IndexError, OverflowError, RecursionError):
            right = False
        if not right:
            raise DatasetError("not the JSON of a model of one detection, or damaged: make it "
                               "again with `sweep.error_model(STORE).to_json()`")
        return model


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
        A store of `photos` with the same setting and solver, or its results: six factors along and
        about the line of sight, the tilt and across widen the covariance, and the errors are
        correlated as far as photographs agree on it, so that it describes them. One photograph
        shows no correlation; errors that are NaN are left out. Judge it on others.

    Returns
    -------
    DetectionModel
        ``model.at(rvec, tvec_m, ambiguity)`` has the 6 x 6 covariance, the bias and the probability
        of a flip of estimated poses, and whether they are known: the simulation has poses there.
        ``model.to_json()`` keeps it.

    Raises
    ------
    StoreError, DatasetError
        If there is no store, fewer than 2,000 solved poses, of which half differ, are not flipped
        and have two solutions, or 50 of photographs, several settings, focal lengths or sizes.

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
    return store if isinstance(store, xr.Dataset) else open_dataset(store)


def widened(model: DetectionModel, photographs: xr.Dataset) -> DetectionModel:
    """Return a model whose covariance is stretched to the errors in photographs.

    Six factors make the variances of the whitened errors 1. Then these are correlated: 1 - s of
    each correlation r is kept, with the share s = sum Var(r) / sum r^2, at most 1, that has the
    least expected squared error (Schäfer and Strimmer, "A shrinkage approach to large-scale
    covariance matrix estimation and implications for functional genomics", Stat. Appl. Genet. Mol.
    Biol. 4:32, 2005, target D). Errors within a photograph are not independent: r is a sum of one
    number for each photograph, and Var(r) the sum of their squares, about 0 and not about their
    mean. With n photographs the share is therefore larger than the paper's, by about (1 - s) / n.
    With a single photograph, for which the paper's share is not defined, it is 1 and no correlation
    is kept; with a few photographs it is near 1 unless they agree.
    """
    for rounds_left in reversed(range(ROUNDS)):  # the truth's own errors are not multiplied
        found = judged(model, photographs).dropna("pose", subset=["whitened"])
        whitened = found["whitened"]
        if len(whitened) < MIN_PHOTOGRAPHED:
            raise DatasetError(
                f"{len(whitened)} known poses of photographs: factors need {MIN_PHOTOGRAPHED} that "
                "are not flipped; take more photographs, or simulate their poses (`sweep.twins`)")
        pairs = whitened * whitened.rename(row="column")
        products = pairs.groupby(found["trial"]).sum().values
        off_diagonal = products * (1.0 - np.eye(6))
        share = (off_diagonal**2).sum() / (off_diagonal.sum(axis=0) ** 2).sum()
        kept = 0.0 if rounds_left else max(1.0 - share, 0.0)
        moments = products.sum(axis=0) / len(whitened) * np.where(np.eye(6), 1.0, kept)
        model = replace(model, log_covariance=_stretched(model.log_covariance, moments))
    return model


def judged(model: DetectionModel, results: xr.Dataset) -> xr.Dataset:
    """Return a model's errors of the solved poses of a dataset, beside their own errors.

    Returns
    -------
    xr.Dataset
        As `estimated`, but ``error`` is less the bias, and as `DetectionModel.at`; ``whitened``
        (pose, row): errors in the frame of `frames`, divided by the root of the sum of both
        covariances, uncorrelated with variance 1 where these are right, so that the sum of their
        squares is 6 on average; NaN of flipped poses and where nothing is known.
    """
    found = estimated(results)
    found = found.assign(model.at(found["rvec"], found["tvec_m"], found["ambiguity"]))
    found["error"] = found["error"] - found["bias"]
    used = found.isel(pose=(found["known"] & ~found["flipped"]).values)
    back = np.linalg.inv(frames(used["rvec"].values, used["tvec_m"].values))
    both = used["covariance"].values + np.eye(6) * used["truth_std"].values[:, None] ** 2
    whitened = _whitened(np.einsum("nij,nj->ni", back, used["error"].values),
                         back @ both @ back.transpose(0, 2, 1))
    # By the numbers of the poses: NaN of those that are not used.
    return found.assign(whitened=used["error"].copy(data=whitened))


def of_simulation(results: xr.Dataset) -> DetectionModel:
    """Return the model of a simulation's poses."""
    found = estimated(results)
    errors, rvec, tvec, ratio, flipped = (
        found[name].values for name in ("error", "rvec", "tvec_m", "ambiguity", "flipped"))
    count = min(len(np.unique(errors[~flipped], axis=0)), int((ratio > 0).sum()))
    if len(tvec) < MIN_POSES or count < MIN_POSES / 2:
        raise DatasetError(f"{len(tvec):,} solved poses, of which {count:,} are not flipped, "
                           "differ and have two solutions; a model of one detection needs "
                           f"{MIN_POSES:,}, and half of that: more trials, noise, or solver ippe")
    focal_sizes = focal_size_of(results)
    focal_size = float(focal_sizes.mean())
    if not np.allclose(focal_sizes, focal_size, rtol=1e-3):
        raise DatasetError("several focal lengths or sizes of the marker: expected a model of each")
    at = _conditions(rvec, tvec, ratio, focal_size)
    # Less what lies along the line of sight: those errors are large and would hide the shift.
    moved = (errors[:, :3] - errors[:, 2:3] / tvec[:, 2:] * tvec) / tvec[:, 2:]
    shift = np.median(np.hstack([moved, errors[:, 3:]])[~flipped], axis=0) * [1, 1, 0, 1, 1, 0]
    side, angle = (np.quantile(at[:, 1 + k], np.linspace(0.0, 1.0, KNOTS[k])) for k in (0, 1))
    angle[0] = 0.0 if angle[0] < FRONTAL_DEG else angle[0]
    errors = errors - shift * _lengths(tvec[:, 2])
    errors = np.einsum("nij,nj->ni", np.linalg.inv(frames(rvec, tvec)), errors)[~flipped]
    basis = hat_basis(at[~flipped, 1:], [side, angle])
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
        whitened = _whitened(errors - basis @ bias, _of_symmetric(
            np.einsum("nk,kij->nij", basis, log_covariance), np.exp))
        log_covariance = _stretched(
            log_covariance, means(whitened[:, :, None] * whitened[:, None, :]))
    # Inverses of covariances of n poses are too large by n / (n - 7) on average (Anderson, "An
    # introduction to multivariate statistical analysis", 2003, section 7.7), and the means' errors
    # add 1 / n. Heavy tails are worth fewer normal poses: n over Mardia's kurtosis / 48.
    tails = max(float(((whitened**2).sum(axis=1) ** 2).mean()) / 48.0, 1.0)
    wider = np.log((poses + tails) / np.maximum(poses - 7.0 * tails, 0.5 * poses + 1.0))
    ambiguity = np.quantile(at[ratio > 0, 0], AMBIGUITY_SHARES)
    model = DetectionModel(
        focal_size, side, angle, ambiguity, shift, bias,
        log_covariance + wider[:, None, None] * np.eye(6), poses, np.zeros(0),
        float(bearing_of(tvec).max()))
    return replace(model, flips=_flip_fit(at, flipped, model.flip_knots))


def estimated(results: xr.Dataset) -> xr.Dataset:
    """Return the solved poses of a dataset with their errors.

    Returns
    -------
    xr.Dataset
        ``error`` (pose, row): estimated minus true, along and about the camera's axes, in metres
        and radians; ``truth_std`` (pose, row): the truth's standard deviations, 0 where they are
        not known; ``rvec``, ``tvec_m`` (pose, xyz): the estimates; ``ambiguity``, 0 of a solver
        that returns one solution alone; ``flipped``; ``trial``: places in the dataset.

    Raises
    ------
    DatasetError
        If there are several settings or solvers, or other variables are missing.
    """
    vectors = ("true_rvec", "true_tvec_m", "rotation_error_rad", "translation_error_m")
    numbers = ("reprojection_error_px", "alternative_reprojection_error_px", "flipped")
    names = [*vectors, *numbers, "estimate"]
    if missing := [name for name in names if name not in results]:
        raise DatasetError(f"no variable {missing[0]}: expected a run that solves poses")
    if "trial" not in results.dims:
        results = results.drop_vars("trial", errors="ignore").expand_dims("trial")
    results = results.assign_coords(trial=np.arange(results.sizes["trial"]))
    scene, dims = results["true_tvec_m"].dims, results["estimate"].dims
    if several := [f"{name} ({results.sizes[name]})" for name in dims
                   if name not in scene and results.sizes[name] > 1]:
        raise DatasetError(f"several settings: {', '.join(several)}: choose one with .isel(...)")
    table = results[names + ["truth_std"] * ("truth_std" in results)].isel(
        dict.fromkeys(set(dims) - set(scene), 0), drop=True).load().stack(
        pose=[dim for dim in scene if dim != "xyz"], create_index=False).transpose("pose", ...)
    solved = (table["estimate"] == EstimateStatus.solved).values
    table = table.isel(pose=solved).dropna("pose", subset=vectors)
    rvec, tvec, rotation, position = (table[name].values.astype(np.float64) for name in vectors)
    chosen, other, flipped = (table[name].values for name in numbers)
    # Of the rotation, then of the position.
    deviations = np.asarray(table.get("truth_std", np.zeros((len(tvec), 6))), np.float64)
    # A solver may return one solution alone: the other error is NaN.
    ratio = np.divide(chosen, other, out=np.zeros(len(other)), where=other > 0)
    turned = vector_of_rotation(rotation_of_vector(rotation) @ rotation_of_vector(rvec))
    return xr.Dataset({
        "error": (("pose", "row"), np.concatenate([position, rotation], axis=1)),
        "truth_std": (("pose", "row"), np.nan_to_num(deviations[:, [3, 4, 5, 0, 1, 2]])),
        "rvec": (("pose", "xyz"), turned), "tvec_m": (("pose", "xyz"), tvec + position),
        "ambiguity": ("pose", ratio), "flipped": ("pose", flipped == Flipped.flipped),
        "trial": table["trial"].variable, "pose": np.arange(len(tvec))})


def frames(rvec: Floats, tvec: Floats) -> Floats:
    """Return the matrices that turn errors (6,) to the camera's axes, in m and rad (n, 6, 6).

    They are of the position over the range and of the rotation, along and about x in the direction
    in which the estimated marker is tilted, y across, z along the line of sight.
    """
    sight = sight_rotation(tvec)
    normal = np.einsum("nji,nj->ni", sight, rotation_of_vector(rvec)[..., 2])
    azimuth = np.arctan2(normal[:, 1], normal[:, 0])
    turn = np.zeros((len(tvec), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = sight @ rotation_of_vector(
        np.outer(azimuth, [0.0, 0.0, 1.0]))
    return np.asarray(turn * _lengths(np.linalg.norm(tvec, axis=1))[:, None])


def _lengths(length: Floats) -> Floats:
    """Return units (n, 6) of errors of which those of positions are relative to a length (n,)."""
    return np.repeat([length, np.ones(len(length))], 3, axis=0).T


def _conditions(rvec: Floats, tvec: Floats, ratio: Floats, focal_size: float) -> Floats:
    """Return ln(ambiguity), ln(side) and viewing angle (n, 3) of estimates."""
    return np.stack([np.log(np.maximum(ratio, 1e-300)), np.log(focal_size / tvec[:, 2]),
                     viewing_angle_of(rvec, tvec)], axis=-1)


def _whitened(errors: Floats, covariance: Floats) -> Floats:
    """Return errors (n, m) divided by the root of their covariances."""
    return np.asarray(np.einsum(
        "nij,nj->ni", _of_symmetric(covariance, lambda values: values**-0.5), errors))


def _stretched(logarithms: Floats, second_moments: Floats) -> Floats:
    """Return logarithms of covariances with which whitened errors had these second moments."""
    root = _of_symmetric(0.5 * logarithms, np.exp)
    return _of_symmetric(root @ second_moments @ root, np.log)


def _of_symmetric(matrices: Floats, function: Callable[[Floats], Floats]) -> Floats:
    """Return a function of symmetric matrices (n, m, m), such as their exponentials."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * function(values)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _flip_fit(at: Floats, flipped: Masks, knots: Sequence[Floats]) -> Floats:
    """Return the coefficients of a logistic regression, by iterated weighted least squares."""
    basis = hat_basis(at, knots)
    ridge = RIDGE * differences(knots) + 1e-3 * np.eye(basis.shape[1])
    start = np.full(basis.shape[1], math.log((flipped.sum() + 0.5) / ((~flipped).sum() + 0.5)))
    found = start
    for _ in range(30):
        chance = 1.0 / (1.0 + np.exp(-(basis @ found)))
        slope = basis.T @ (flipped - chance) - ridge @ (found - start)
        curve = (basis * (chance * (1.0 - chance))[:, None]).T @ basis + ridge
        found = found + np.clip(np.linalg.solve(curve, slope), -2.0, 2.0)
    return found
