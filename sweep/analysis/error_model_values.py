"""Values of an error model at poses: bias, standard deviation and covariance."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sweep.analysis.error_model_bins import PREDICTORS
from sweep.analysis.error_model_fit import hat_basis
from sweep.analysis.error_model_sums import QUANTITIES
from sweep.analysis.error_models import Use
from sweep.analysis.sight_frame import sight_rotation
from sweep.errors import ArgumentError
from sweep.typing import Floats, Integers


def model_errors(
    model: xr.Dataset, distance_m: ArrayLike, viewing_angle_deg: ArrayLike,
    side_px: ArrayLike | None = None,
) -> xr.Dataset:
    """Return bias and standard deviation of the pose's error at some conditions.

    Parameters
    ----------
    model
        One model of `error_models`: choose a configuration with ``models.isel(...)``.
    distance_m
        Distances (n,) along the optical axis.
    viewing_angle_deg
        Angles (n,) between the marker's normal and the line of sight.
    side_px
        Sides (n,) of the black square, were it parallel to the image; by default what follows from
        the distance, if the store has one size and one focal length.

    Returns
    -------
    xr.Dataset
        ``sigma``, ``bias`` (n, quantity), in metres and radians, in the sight frame; ``use`` (n,
        quantity), flags of `Use`; ``flip_rate``, ``solved_rate`` (n,) of the cell. Outside the
        store's conditions all are NaN and ``use`` is ``no_poses``.

    Raises
    ------
    ArgumentError
        If there are several models, or no side where it does not follow.

    Notes
    -----
    ln(sigma) and the bias (of positions: over the distance) are linear between the knots of the
    model in ln(distance), ln(side) and the angle.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> from sweep.analysis import error_models
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> found = model_errors(models.isel(solver=0), [1.0, 99.0], 0.0)
    >>> found["sigma"].sel(quantity="z").round(5).values.tolist()
    [0.00076, nan]
    """
    if model["sigma"].dims != ("quantity", *PREDICTORS):
        others = [str(dim) for dim in model["sigma"].dims if dim not in ("quantity", *PREDICTORS)]
        raise ArgumentError("model", f"models for each {', '.join(others)}",
                            "expected one model; choose one with models.isel(...)")
    distance, angle = (np.atleast_1d(np.asarray(each, dtype=np.float64))
                       for each in (distance_m, viewing_angle_deg))
    if side_px is None:
        if model.attrs["focal_size_varies"]:
            raise ArgumentError("side_px", None, "expected the side: it varies in the store")
        with np.errstate(divide="ignore"):
            side_px = model.attrs["focal_size_px_m"] / distance
    distance, side, angle = np.broadcast_arrays(
        distance, np.atleast_1d(np.asarray(side_px, dtype=np.float64)), angle)
    cell, inside = _cells(model, distance, side, angle)
    knots = [np.log(model[name].values) if logarithmic else model[name].values
             for name, logarithmic in PREDICTORS.items()]
    with np.errstate(divide="ignore", invalid="ignore"):
        basis = hat_basis(np.stack([np.log(distance), np.log(side), angle], axis=-1), knots)
    scale = np.where(np.arange(len(QUANTITIES)) < 3, 1.0, 0.0)[:, None]
    metres = scale * model["distance_m"].values + (1.0 - scale)
    bias = model["bias"].values / metres[:, :, None, None]
    flat = (len(QUANTITIES), -1)
    values = {
        "sigma": np.exp(basis @ np.log(model["sigma"].values).reshape(flat).T),
        "bias": basis @ bias.reshape(flat).T * (scale[:, 0] * distance[:, None] + 1 - scale[:, 0]),
    }
    use = model["use"].values.reshape(flat)[:, cell].T
    inside &= (use != Use.no_poses).all(axis=1)
    out: dict[str, Any] = {
        name: (("pose", "quantity"), np.where(inside[:, None], each, np.nan),
               {"units": "m, radian"}) for name, each in values.items()}
    out["use"] = (("pose", "quantity"), np.where(inside[:, None], use, Use.no_poses),
                  model["use"].attrs)
    for name in ("flip_rate", "solved_rate"):
        rate = model[name].values.ravel()[cell]
        out[name] = ("pose", np.where(inside, rate, np.nan), model[name].attrs)
    return xr.Dataset(out, {"quantity": list(QUANTITIES)})


def model_covariance(
    model: xr.Dataset, position_m: ArrayLike, viewing_angle_deg: ArrayLike,
    side_px: ArrayLike | None = None,
) -> xr.Dataset:
    """Return covariance and bias of the pose's error along and about the camera's axes.

    Parameters
    ----------
    model, viewing_angle_deg, side_px
        As in `model_errors`.
    position_m
        Positions (n, 3) of the marker in the camera's frame; estimated ones do.

    Returns
    -------
    xr.Dataset
        ``covariance`` (pose, row, column) and ``bias`` (pose, row) in the order x, y, z (m),
        rotation about x, y, z (rad): that of the message ``geometry_msgs/PoseWithCovariance`` of
        ROS, whose 36 numbers are the rows one after another. Subtract the bias from the estimate
        before the covariance describes what is left. ``use`` as in `model_errors`.

    Raises
    ------
    ArgumentError
        As in `model_errors`.

    Notes
    -----
    Q diag(sigma²) Qᵀ for position and rotation each, with Q of `sight_rotation`.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> from sweep.analysis import error_models
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> pose = model_covariance(models.isel(solver=0), [0.5, 0.0, 1.0], 0.0)
    >>> pose["covariance"].shape, bool(pose["covariance"][0, 0, 2] > 0)
    ((1, 6, 6), True)
    """
    position = np.atleast_2d(np.asarray(position_m, dtype=np.float64))
    values = model_errors(model, position[:, 2], viewing_angle_deg, side_px)
    turn = sight_rotation(position)
    covariance = np.zeros((len(position), 6, 6))
    bias = np.zeros((len(position), 6))
    for part in (slice(0, 3), slice(3, 6)):
        variance = values["sigma"].values[:, part] ** 2
        covariance[:, part, part] = np.einsum("nij,nj,nkj->nik", turn, variance, turn)
        bias[:, part] = np.einsum("nij,nj->ni", turn, values["bias"].values[:, part])
    return xr.Dataset({
        "covariance": (("pose", "row", "column"), covariance, {"units": "m2, m rad, rad2"}),
        "bias": (("pose", "row"), bias, {"units": "m, radian"}), "use": values["use"],
    })


def cell_edges(model: xr.Dataset, name: str) -> Floats:
    """Return the edges of a model's cells along a predictor."""
    low, high = (model[f"cell_{name}_{end}"].values for end in ("low", "high"))
    return np.append(low, high[-1])


def _cells(model: xr.Dataset, *values: Floats) -> tuple[Integers, Any]:
    """Return the flat numbers of the cells of points, and whether they are in one."""
    inside, flat = np.ones(values[0].shape, dtype=bool), np.zeros(values[0].shape, dtype=np.int64)
    for each, name in zip(values, PREDICTORS, strict=True):
        edges = cell_edges(model, name)
        number = np.searchsorted(edges[1:-1], each, side="right")
        inside &= (each >= edges[0]) & (each <= edges[-1])
        flat = flat * (len(edges) - 1) + number
    return flat, inside
