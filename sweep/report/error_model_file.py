"""Error models of a store: their table and their JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import error_models
from sweep.analysis.dataset import each_cell
from sweep.analysis.error_models import CONDITIONS, PREDICTORS, QUANTITIES, Use, cell_edges
from sweep.analysis.estimator import INTERVAL
from sweep.analysis.requirements import described
from sweep.errors import ArgumentError
from sweep.messages import to_json
from sweep.report.output_file import check_output_file, write_output_file
from sweep.report.report_data import ReportData
from sweep.report.table import Column, Findings, Table, table_of
from sweep.typing import Integers
from sweep.version import __version__

#: What every file says: schema, frame, formula, and what the errors are.
TEMPLATE = Path(__file__).parent / "templates" / "error_model.json"

#: Variables of the models that the file has of each quantity.
OF_QUANTITIES = (
    *(f"{name}{end}" for name in ("sigma", "bias") for end in INTERVAL), "knots",
    "coverage")

#: Of the usual rule for one tag: sigma = 0.02 d² metres.
RULE_M = 0.02

#: Warnings of every model.
ALWAYS = (
    "sigma is of poses that are not flipped: where flips are not rejected, flip_rate counts too",
    "azimuth, roll and direction of the bearing are pooled; other cameras, markers, light differ",
)


def check_error_model_file(path: str) -> None:
    """Check that a file is to hold JSON.

    Raises
    ------
    ArgumentError
        If its name ends in another suffix.
    """
    if Path(path).suffix.lower() != ".json":
        raise ArgumentError(
            "error_model", path, "expected a file that ends in .json; pipelines/pose_errors.py "
            "reads it, and sweep.analysis.model_covariance gives covariances for ROS")


def document(models: xr.Dataset, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a file; NaN and infinities are null.

    Parameters
    ----------
    models
        As `sweep.analysis.error_models` returns them.
    facts
        Source of the models: ``store``, ``title``, ``fingerprint``, ``camera``, ``pipeline``.
    """
    edges = {name: cell_edges(models, name).tolist() for name in PREDICTORS}
    knots = {name: models[name].values.tolist() for name in PREDICTORS}
    return {
        **json.loads(TEMPLATE.read_text(encoding="utf-8")), "sweep": __version__, **facts,
        "units": {name: each.units for name, each in CONDITIONS.items()},
        "conditions": {name: each.words for name, each in CONDITIONS.items()},
        "flags": {each.name: each.meaning for each in Use},
        "warnings": warnings_of(models),
        "models": [
            {
                "configuration": configuration,
                "side_px_times_distance_m": None if models.attrs["focal_size_varies"] else
                models.attrs["focal_size_px_m"],
                "region": [dict(zip(("weights", "low", "high"), each, strict=True))
                           for each in zip(*(model[name].values.tolist() for name in (
                               "direction_weight", "region_low", "region_high")), strict=True)],
                "knots": knots,
                "knots_u": [_logarithms(name, values) for name, values in knots.items()],
                "cells": edges,
                "cells_u": [_logarithms(name, ends[1:-1]) for name, ends in edges.items()],
                **{name: model[name].values.tolist()
                   for name in ("looked_for", "solved_rate", "flip_rate", "judged")},
                "quantities": {name: _quantity(model.sel(quantity=name)) for name in QUANTITIES},
            }
            for configuration, _, model in models_apart(models)
        ],
    }


def _logarithms(name: str, values: Any) -> Any:
    """Return values of a condition as they stand in u."""
    return CONDITIONS[name].scaled(values).tolist()


def _quantity(model: xr.Dataset) -> dict[str, Any]:
    """Return the numbers for a reader's formula, and all variables, of one quantity."""
    metres = str(model["quantity"].item()) in QUANTITIES[:3]
    scale = model["distance_m"].values[:, None, None] if metres else 1.0
    names = np.array([Use(flag).name for flag in model["use"].values.ravel()], dtype=object)
    return {
        "unit": "m" if metres else "radian",
        "ln_sigma": np.log(model["sigma"].values).tolist(),
        "bias_u": (model["bias"].values / scale).tolist(),
        **{name: model[name].values.tolist() for name in OF_QUANTITIES},
        "use": names.reshape(model["use"].shape).tolist(),
    }


def models_apart(models: xr.Dataset) -> list[tuple[dict[str, Any], str, xr.Dataset]]:
    """Return the values of the axes by which models are kept apart, these in words, and each."""
    dims = [str(dim) for dim in models["knots"].dims if dim not in ("quantity", "predictor")]
    return [(at, described(at, " = ") or "the configuration", model)
            for at, model in each_cell(models, dims)]


def warnings_of(models: xr.Dataset) -> list[str]:
    """Return sentences on where the models must not be used, beside the flags of the cells."""
    lines = []
    for _, name, model in models_apart(models):
        use = model["use"].values
        counted = use[:, (use != Use.no_poses).any(axis=0)]
        parts = [f"{100 * float((counted == flag).mean()):.0f} % {flag.name}" for flag in Use
                 if flag != Use.no_poses and (counted == flag).any()]
        lines.append(f"{name}: of {counted.size:,} cells (times errors): {', '.join(parts)}")
    for name in PREDICTORS:
        if models.sizes[name] == 1 and not (
            name == "side_px" and models.sizes["distance_m"] > 1
            and not models.attrs["focal_size_varies"]):
            value = float(models[name][0])
            lines.append(f"{name} did not vary ({value:.4g} {CONDITIONS[name].units}): the models "
                         "hold there alone")
    bearing = models["direction_weight"].values[:, list(CONDITIONS).index("bearing_deg")] == 1
    low, high = (float(extreme(models[f"region_{end}"].values[..., bearing]))
                 for end, extreme in (("low", np.min), ("high", np.max)))
    lines.append(f"bearings from {low:.4g} to {high:.4g} degree: the models hold there alone")
    return [*lines, *ALWAYS]


def model_findings(data: ReportData, paths: Sequence[str]) -> Findings:
    """Write the error models of a store; return their table and warnings.

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
    models = error_models(data.results)
    content = document(models, {
        "store": data.store, "title": data.pipeline.heading,
        "camera": data.pipeline.facts.camera_line,
        "fingerprint": dict(data.run_metadata.get("fingerprint", {})),
        "pipeline": data.pipeline.text,
    })
    for path in paths:
        write_output_file(Path(path), f"{to_json(content, indent=1)}\n".encode())
    return Findings(
        [error_model_table(models), *(f"- {line}" for line in warnings_of(models))],
        content, models, 0,
        (f"look at {', '.join(paths)}", "sigma and bias anywhere in the store's domain"))


# The table.

CAPTION = (
    "Standard deviation (95 % interval) and bias of the error of poses without flips, in the sight "
    "frame: z along the line of sight"
)
#: Most knots of each condition that the table shows.
SHOWN = dict(zip(PREDICTORS, (4, 3, 3), strict=True))


def error_model_table(models: xr.Dataset) -> Table:
    """Return a table with a row for some knots at which each configuration has poses."""
    places = {name: np.unique(np.linspace(0, models.sizes[name] - 1, most).round().astype(int))
              for name, most in SHOWN.items()}
    some = models.isel(places)
    cells = {f"cell_{name}": (name, np.searchsorted(
        cell_edges(models, name)[1:-1], some[name].values, side="right")) for name in PREDICTORS}
    use = some["use"].isel({name: xr.DataArray(at, dims=dim) for name, (dim, at) in cells.items()})
    # Positions in mm, rotations in degrees.
    scale = xr.DataArray([1e3] * 3 + [float(np.degrees(1.0))] * 3, dims="quantity")
    columns = {f"{quantity}{end}": (scale * some[f"sigma{end}"]).sel(quantity=quantity, drop=True)
               for quantity in QUANTITIES for end in INTERVAL}
    sigma_z, bias_z = (some[name].sel(quantity="z", drop=True) for name in ("sigma", "bias"))
    table = xr.Dataset(columns).assign(
        bias=1e3 * bias_z, rule=RULE_M * some["distance_m"]**2 / sigma_z,
        seen=(use != Use.no_poses).any("quantity").astype(int),
        use=xr.apply_ufunc(_use, use, input_core_dims=[["quantity"]], vectorize=True,
                           output_dtypes=[object]))
    kept = [str(dim) for dim in models["knots"].dims if dim not in ("quantity", "predictor")]
    return table_of(
        table, CAPTION, [*kept, *PREDICTORS],
        [Column("held-out check", "use"), *(
            Column(f"{quantity.replace('_', ' ')}, {'deg' if 'rotation' in quantity else 'mm'}",
                   quantity) for quantity in QUANTITIES),
         Column("bias of z, mm", "bias"), Column("0.02 d² / sigma z", "rule")],
        models, counted="seen")


def _use(flags: Integers) -> str:
    """Return the flags of the six errors in words."""
    return ", ".join(Use(int(flag)).name.replace("_", " ") for flag in np.unique(flags))
