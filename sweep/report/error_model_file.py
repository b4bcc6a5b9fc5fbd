"""Error models of a store: their table and their JSON."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.error_models import (
    CONDITIONS,
    PREDICTORS,
    QUANTITIES,
    UNITS,
    VARIES,
    WORDS,
    Use,
    cell_edges,
    error_models,
    model_errors,
)
from sweep.errors import ArgumentError
from sweep.messages import to_json
from sweep.report.output_file import check_output_file, write_output_file
from sweep.report.report_data import ReportData
from sweep.report.table import Findings, Table, interval_text, number
from sweep.version import __version__

SCHEMA = "sweep-error-model/2"

FRAME = (
    "sight frame: the camera's frame (x right, y down, z forward), turned by the shortest way so "
    "that z is the line of sight to the marker's centre"
)
FORMULA = {
    "u": "(ln(distance_m), ln(side_px), viewing_angle_deg, bearing_deg)",
    "region": "u was seen if low <= sum of weights * u <= high for every direction, and if seen is "
              "true for its cell (boundaries lie between cells); elsewhere there is no answer",
    "weight": "product of hat functions of u at knots_u: 1 at its knot, 0 at the others, linear "
              "between",
    "sigma": "exp(sum over knots of weight * ln_sigma)",
    "bias": "sum over knots of weight * bias_u; of x, y, z times distance_m",
    "use": "of the cell of u (cells_u lie between cells)",
    "covariance": "Q diag(sigma^2) Q^T along and about the camera's axes, Q bias its bias, for "
                  "x, y, z and the rotation each. With the unit vector (a, b, c) to the marker "
                  "and k = 1 / (1 + c): Q = [[1 - k a^2, -k a b, a], [-k a b, 1 - k b^2, b], "
                  "[-a, -b, c]]",
}
"""How the numbers of the file are used."""

RULE_M = 0.02
"""Of the usual rule for one tag: sigma = 0.02 d² metres."""

ALWAYS = (
    "sigma is of poses that are not flipped: where flips are not rejected, flip_rate counts too",
    "azimuth, roll and direction of the bearing are pooled; other cameras, markers, light differ",
)
"""Warnings of every model."""


def check_error_model_file(path: str) -> None:
    """Check that a file is to hold JSON.

    Raises
    ------
    ArgumentError
        If its name ends in another suffix.
    """
    if Path(path).suffix.lower() != ".json":
        raise ArgumentError(
            "error_model", path, "expected a file that ends in .json: the model is its formula and "
            "coefficients, for any language; sweep/analysis/README.md has a reader of 20 lines in "
            "Python, and sweep.analysis.model_covariance gives covariances for ROS")


def error_model_text(models: xr.Dataset, facts: Mapping[str, Any]) -> str:
    """Return the content of a file.

    Parameters
    ----------
    models
        As `sweep.analysis.error_models` returns them.
    facts
        What the models are of: ``store``, ``title``, ``fingerprint``, ``camera``, ``pipeline``.
    """
    return to_json(document(models, facts), indent=1) + "\n"


def document(models: xr.Dataset, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the file; what is not a number is null."""
    flat = stacked(models)
    edges = {name: cell_edges(models, name).tolist() for name in PREDICTORS}
    return {
        "schema": SCHEMA, "sweep": __version__, **facts,
        "frame": FRAME, "formula": FORMULA,
        "errors": "estimated minus true; rotations as rotation vector of R_est R_trueᵀ; poses that "
                  "are solved and not flipped",
        "units": UNITS,
        "conditions": dict(WORDS),
        "flags": {each.name: each.meaning for each in Use},
        "warnings": warnings_of(models),
        "models": [
            {
                "configuration": configuration,
                "side_px_times_distance_m": None if models.attrs["focal_size_varies"] else
                models.attrs["focal_size_px_m"],
                "region": _region(flat.isel(model=k)),
                "knots": {name: flat[name].values.tolist() for name in PREDICTORS},
                "knots_u": [_logarithms(name, flat[name].values) for name in PREDICTORS],
                "cells": edges,
                "cells_u": [_logarithms(name, ends[1:-1]) for name, ends in edges.items()],
                **{name: flat[name].isel(model=k).values.tolist()
                   for name in ("looked_for", "solved_rate", "flip_rate", "judged")},
                "quantities": {
                    quantity: _quantity(flat.isel(model=k).sel(quantity=quantity))
                    for quantity in QUANTITIES
                },
                "rule_of_thumb": _rule(flat.isel(model=k)),
            }
            for k, configuration in enumerate(configurations(models))
        ],
    }


def _region(model: xr.Dataset) -> dict[str, Any]:
    """Return the joint region of a model: ends along directions, and cells with poses."""
    ends = zip(*(model[name].values.tolist()
                 for name in ("direction_weight", "region_low", "region_high")), strict=True)
    return {
        "directions": [dict(zip(("weights", "low", "high"), each, strict=True)) for each in ends],
        "boundaries": [_logarithms(name, model[f"region_{name}"].values[1:])
                       for name in CONDITIONS],
        "seen": model["region_seen"].values.tolist(),
    }


def _logarithms(name: str, values: Any) -> Any:
    """Return values of a condition as they stand in u."""
    return (np.log(values) if CONDITIONS[name] else np.asarray(values)).tolist()


def _quantity(model: xr.Dataset) -> dict[str, Any]:
    names = [Use(value).name for value in model["use"].values.ravel()]
    metres = str(model["quantity"].item()) in QUANTITIES[:3]
    scale = model["distance_m"].values[:, None, None] if metres else 1.0
    return {
        "unit": "m" if metres else "radian",
        "ln_sigma": (np.log(model["sigma"].values)).tolist(),
        "bias_u": (model["bias"].values / scale).tolist(),
        "sigma": model["sigma"].values.tolist(),
        "sigma_interval": [model[f"sigma_{end}"].values.tolist() for end in ("low", "high")],
        "bias": model["bias"].values.tolist(),
        "bias_interval": [model[f"bias_{end}"].values.tolist() for end in ("low", "high")],
        "knots_needed": model["knots"].values.tolist(),
        "exponent": model["exponent"].values.tolist(),
        "exponent_interval": [model[f"exponent_{end}"].values.tolist() for end in ("low", "high")],
        "coverage": model["coverage"].values.tolist(),
        "camera_coverage": model["camera_coverage"].values.tolist(),
        "use": np.reshape(np.array(names, dtype=object), model["use"].shape).tolist(),
    }


def _rule(model: xr.Dataset) -> dict[str, Any]:
    """Return how the usual rule for one tag compares with sigma of z at the knots."""
    rule = RULE_M * model["distance_m"] ** 2
    ratio = (rule / model["sigma"].sel(quantity="z")).transpose(*PREDICTORS)
    return {"rule": "sigma = 0.02 d² m", "ratio_to_sigma_of_z": ratio.values.tolist()}


def stacked(models: xr.Dataset) -> xr.Dataset:
    """Return the models with one dimension ``model`` in front, in place of those kept apart."""
    kept = kept_of(models)
    flat = models.drop_vars([name for name in kept if name in models.coords])
    flat = flat.stack(model=kept, create_index=False) if kept else flat.expand_dims("model")
    return flat.transpose("model", "quantity", *PREDICTORS, *(f"cell_{n}" for n in PREDICTORS),
                          *(f"region_{n}" for n in CONDITIONS), "direction", ...)


def kept_of(models: xr.Dataset) -> list[str]:
    """Return the dimensions that keep models apart, in order."""
    return [str(dim) for dim in models["exponent"].dims if dim != "quantity"]


def configurations(models: xr.Dataset) -> list[dict[str, Any]]:
    """Return the values of the axes that models are kept apart by, of each model."""
    kept = kept_of(models)
    shape = [models.sizes[name] for name in kept]
    return [
        {name: np.asarray(models[name].values[k]).item()
         for name, k in zip(kept, index, strict=True)}
        for index in np.ndindex(*shape)
    ]


def configuration_names(models: xr.Dataset) -> list[str]:
    """Return each model's configuration in words; one without axes is "the configuration"."""
    return [", ".join(f"{name} = {value}" for name, value in each.items()) or "the configuration"
            for each in configurations(models)]


def warnings_of(models: xr.Dataset) -> list[str]:
    """Return sentences on where the models must not be used, beside the flags of the cells."""
    lines, uses = [], stacked(models)["use"].values
    for use, name in zip(uses, configuration_names(models), strict=True):
        counted = use[:, (use != Use.no_poses).any(axis=0)]
        parts = [f"{100 * float((counted == flag).mean()):.0f} % {flag.name}" for flag in Use
                 if flag != Use.no_poses and (counted == flag).any()]
        lines.append(f"{name}: of {counted.size:,} cells (times errors): {', '.join(parts)}")
    for name in PREDICTORS:
        if models.sizes[name] == 1 and not (
            name == "side_px" and models.sizes["distance_m"] > 1
            and not models.attrs["focal_size_varies"]):
            value = float(models[name][0])
            lines.append(f"{name} did not vary ({value:.4g} {UNITS[name]}): the models hold "
                         "there alone")
    bearing = models["direction_weight"].values[:, list(CONDITIONS).index("bearing_deg")] == 1
    low, high = (float(extreme(models[f"region_{end}"].values[..., bearing]))
                 for end, extreme in (("low", np.min), ("high", np.max)))
    lines.append(f"bearings from {low:.4g} to {high:.4g} {UNITS['bearing_deg']}: the models hold "
                 "there alone")
    return [*lines, *ALWAYS]


def written_error_models(data: ReportData, paths: Sequence[str]) -> xr.Dataset:
    """Write the error models of a store into files, and return them.

    Parameters
    ----------
    data
        The store.
    paths
        Files whose names end in ``.json``.

    Raises
    ------
    ArgumentError
        If one ends in another suffix.
    StoreError
        If a file cannot be written.
    DatasetError
        As `sweep.analysis.error_models`.
    """
    for path in paths:
        check_error_model_file(path)
        check_output_file(Path(path))
    models = models_of(data)
    content = error_model_text(models, facts_of(data)).encode()
    for path in paths:
        write_output_file(Path(path), content)
    return models


def model_findings(data: ReportData, paths: Sequence[str]) -> Findings:
    """Write the error models of a store into files; return their table and warnings."""
    models = written_error_models(data, paths)
    return Findings(
        [error_model_table(models),
         *(f"- {line}" for line in (*exponent_lines(models), *warnings_of(models)))],
        document(models, facts_of(data)), models, 0,
        (f"look at {', '.join(paths)}", "sigma and bias anywhere in the store's domain"))


def models_of(data: ReportData) -> xr.Dataset:
    """Return the error models of a store; they are made once."""
    return data.once(error_models.__name__, lambda: error_models(data.results))


def facts_of(data: ReportData) -> dict[str, Any]:
    """Return what the models are of."""
    return {
        "store": data.store, "title": data.pipeline.heading,
        "camera": data.pipeline.facts.camera_line,
        "fingerprint": dict(data.run_metadata.get("fingerprint", {})),
        "pipeline": data.pipeline.text,
    }


# The table.

CAPTION = (
    "Standard deviation (95 % interval) and bias of the error of poses without flips, in the sight "
    "frame: z along the line of sight"
)
MAX_DISTANCES, MAX_SIDES = 4, 3
ANGLES_DEG = (0.0, 30.0, 60.0)
"""The table has the knots nearest to these."""


def error_model_tables(data: ReportData) -> tuple[Table, ...]:
    """Return the table of a store's error models if they were made, as `--error-model` does."""
    models = data.made.get(error_models.__name__)
    return () if models is None else (error_model_table(models),)


def error_model_table(models: xr.Dataset) -> Table:
    """Return a table with a row for some distances and viewing angles of each configuration."""
    names, flat = configuration_names(models), stacked(models)
    rows = []
    for k, name in enumerate(names):
        model = flat.isel(model=k)
        label = [name] if len(names) > 1 else []
        rows += [[*label, *row] for at in _points(model) if (row := _row(model, at))]
    several = ["configuration"] if len(names) > 1 else []
    sided = ["side, px"] if models.sizes["side_px"] > 1 else []
    headings = [
        *several, "distance, m", *sided, "viewing angle, deg",
        "held-out check", "x, mm", "y, mm", "z, mm",
        "rotation x, deg", "rotation y, deg", "rotation z, deg",
        "bias of z, mm", "0.02 d² / sigma z",
    ]
    return Table.of(CAPTION, headings, rows, stub=len(several) + 2 + len(sided))


def exponent_lines(models: xr.Dataset) -> list[str]:
    """Return, for each configuration, with which power of the distance sigma of z goes."""
    flat = stacked(models)
    lines = []
    for k, name in enumerate(configuration_names(models)):
        z = flat.isel(model=k).sel(quantity="z")
        power, low, high = (float(z[f"exponent{end}"]) for end in ("", "_low", "_high"))
        if not np.isfinite(power):
            continue
        fits = int(z["knots"].sel(predictor="distance_m")) <= 2 and (
            int(z["knots"].sel(predictor="side_px")) <= 2)
        of = "distance" if models.sizes["distance_m"] > 1 else "side"
        lines.append(
            f"{name}: sigma of z goes with the {of} to the power {number(power)} "
            f"({interval_text(low, high)})"
            + ("" if fits else "; a power law does not describe it, the knots do"))
    return lines


def _points(model: xr.Dataset) -> list[dict[str, int]]:
    """Return indices of the knots that the table has: of the seen ones if those are few."""
    angles = model["viewing_angle_deg"].values
    some = [
        _spread(model.sizes["distance_m"], MAX_DISTANCES),
        _spread(model.sizes["side_px"], MAX_SIDES),
        sorted({int(np.abs(angles - each).argmin()) for each in ANGLES_DEG}),
    ]
    points = [dict(zip(PREDICTORS, index, strict=True)) for index in itertools.product(*some)]
    if any(_row(model, at) for at in points):
        return points
    every = [dict(zip(PREDICTORS, index, strict=True))
             for index in np.ndindex(*(model.sizes[name] for name in PREDICTORS))]
    seen = [at for at in every if _row(model, at)]
    return [seen[k] for k in _spread(len(seen), MAX_DISTANCES * MAX_SIDES)] if seen else []


def _spread(count: int, most: int) -> list[int]:
    return sorted({round(float(each)) for each in np.linspace(0, count - 1, min(count, most))})


def _row(model: xr.Dataset, at: dict[str, int]) -> list[str]:
    """Return the texts of a knot, none if the store has no poses there."""
    point = model.isel(at)
    distance, angle = (float(point[name]) for name in ("distance_m", "viewing_angle_deg"))
    side = float(point["side_px"]) if model.attrs["focal_size_varies"] else None
    use = model_errors(model, _held(model, "distance_m", distance), _held(
        model, "viewing_angle_deg", angle), side)["use"].values[0]
    if (use == Use.no_poses).all():
        return []
    texts = []
    for k, name in enumerate(QUANTITIES):
        scale = 1e3 if k < 3 else float(np.degrees(1.0))
        sigma, low, high = (
            scale * float(point[f"sigma{end}"].sel(quantity=name)) for end in ("", "_low", "_high"))
        texts.append(f"{number(sigma)} ({interval_text(low, high)})")
    sided = [number(float(point["side_px"]))] if model.sizes["side_px"] > 1 else []
    bias = 1e3 * float(point["bias"].sel(quantity="z"))
    ratio = RULE_M * distance**2 / float(point["sigma"].sel(quantity="z"))
    return [number(distance), *sided, number(angle), _use(use), *texts, number(bias), number(ratio)]


def _held(model: xr.Dataset, name: str, value: float) -> float:
    """Return a knot, moved into the model's region if it is another model's end beside it."""
    k = list(CONDITIONS).index(name)
    low, high = (float(model[f"region_{end}"][k]) for end in ("low", "high"))
    if CONDITIONS[name]:
        low, high = math.exp(low), math.exp(high)
        near = low / VARIES[name] < value < high * VARIES[name]
    else:
        near = low - VARIES[name] < value < high + VARIES[name]
    return min(max(value, low), high) if near else value


def _use(use: Iterable[int]) -> str:
    """Return whether the models of a cell hold, and of which errors they do not."""
    by_flag: dict[int, list[str]] = {}
    for flag, name in zip(use, QUANTITIES, strict=True):
        by_flag.setdefault(int(flag), []).append(name.replace("_", " "))
    if len(by_flag) == 1:
        return Use(next(iter(by_flag))).name.replace("_", " ")
    return "; ".join(f"{', '.join(names)} {Use(flag).name.replace('_', ' ')}"
                     for flag, names in by_flag.items() if flag != Use.holds)
