"""Error models as files: JSON, C++, Python, Java, and covariances for ROS."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jinja2 import Environment, PackageLoader, StrictUndefined

from sweep.analysis.dimensions import axes_of
from sweep.analysis.error_model_bins import PREDICTORS
from sweep.analysis.error_model_sums import QUANTITIES
from sweep.analysis.error_model_values import cell_edges, model_covariance
from sweep.analysis.error_models import UNITS, WORDS, Use, error_models, is_kept
from sweep.errors import ArgumentError
from sweep.plan.camera_facts import camera_facts
from sweep.plan.cell_selection import parse_selection
from sweep.report.output_file import check_output_file, write_output_file
from sweep.report.report_data import ReportData
from sweep.version import __version__

SCHEMA = "sweep-error-model/1"

FORMATS = {".json": "json", ".hpp": "cpp", ".h": "cpp", ".py": "python", ".java": "java",
           ".yaml": "ros", ".yml": "ros"}
"""Suffix of a file -> what is written into it."""

FRAME = (
    "sight frame: the camera's frame (x right, y down, z forward), turned by the shortest way so "
    "that z is the line of sight to the marker's centre"
)
INTERPOLATION = (
    "ln(sigma) and bias are linear between knots in ln(distance_m), ln(side_px) and "
    "viewing_angle_deg; biases of x, y, z are interpolated as bias / distance_m. No extrapolation."
)
RULE_M = 0.02
"""Of the usual rule for one tag: sigma = 0.02 d² metres."""


ALWAYS = (
    "sigma is of poses that are not flipped: where flips are not rejected, flip_rate counts too",
    "azimuth, roll and bearing are the store's, pooled; other cameras, markers and light differ",
)
"""Warnings of every model."""

MAX_CODE = 20_000
"""Standard deviations at knots up to which they are written as code."""


def check_error_model_file(path: str) -> str:
    """Return the format of a file by its suffix.

    Raises
    ------
    ArgumentError
        If it is none of `FORMATS`.
    """
    form = FORMATS.get(Path(path).suffix.lower())
    if form is None:
        raise ArgumentError("error_model", path, f"expected a file that ends in {_suffixes()}")
    if form == "java" and not Path(path).stem.isidentifier():
        raise ArgumentError("error_model", path, "expected the name of a Java class, such as "
                            "ErrorModel.java")
    return form


def error_model_text(models: xr.Dataset, facts: Mapping[str, Any], path: str) -> str:
    """Return the content of a file.

    Parameters
    ----------
    models
        As `sweep.analysis.error_models` returns them.
    facts
        What the models are of: ``store``, ``title``, ``fingerprint``, ``camera``, ``marker``.
    path
        The file: its suffix says which format.
    """
    form = check_error_model_file(path)
    if form != "json" and models["sigma"].size > MAX_CODE:
        raise ArgumentError("error_model", path, f"{models['sigma'].size:,} numbers are too many "
                            "for code; choose a configuration, or write JSON")
    if form == "json":
        return json.dumps(document(models, facts), indent=1, allow_nan=False) + "\n"
    flat = stacked(models)
    edges = {name: cell_edges(models, name).tolist() for name in PREDICTORS}
    shape = [flat.sizes[name] for name in PREDICTORS]
    distance = flat["distance_m"].values[None, None, :, None, None]
    position = np.arange(len(QUANTITIES))[None, :, None, None, None] < 3
    template = _environment().get_template(f"error_model.{form}.jinja")
    return template.render(
        facts=facts, version=__version__, name=Path(path).stem, frame=FRAME,
        interpolation=INTERPOLATION, flags=list(Use), predictors=list(PREDICTORS),
        quantities=list(QUANTITIES), configurations=configuration_names(models),
        count=flat.sizes["model"], shape=shape,
        cells=[len(each) - 1 for each in edges.values()],
        knots=[(np.log(flat[name].values) if logarithmic else flat[name].values).tolist()
               for name, logarithmic in PREDICTORS.items()],
        edges=list(edges.values()),
        focal_size=math.nan if models.attrs["focal_size_varies"] else models.attrs[
            "focal_size_px_m"],
        log_sigma=_flat(np.log(flat["sigma"].values)),
        bias=_flat(np.where(position, flat["bias"].values / distance, flat["bias"].values)),
        use=flat["use"].values.ravel().tolist(),
        flip_rate=_flat(flat["flip_rate"].values), solved_rate=_flat(flat["solved_rate"].values),
        covariances=list(_covariances(flat)) if form == "ros" else [],
        warnings=warnings_of(models),
    )


def document(models: xr.Dataset, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the JSON file; what is not a number is null."""
    flat = stacked(models)
    edges = {name: cell_edges(models, name).tolist() for name in PREDICTORS}
    return {
        "schema": SCHEMA, "sweep": __version__, **facts,
        "frame": FRAME, "interpolation": INTERPOLATION,
        "errors": "estimated minus true; rotations as rotation vector of R_est R_trueᵀ; poses that "
                  "are solved and not flipped",
        "units": {"distance_m": "m", "side_px": "px", "viewing_angle_deg": "degree",
                  **{name: "m" if k < 3 else "radian" for k, name in enumerate(QUANTITIES)}},
        "predictors": dict(WORDS),
        "side_px": None if models.attrs["focal_size_varies"] else
        f"{models.attrs['focal_size_px_m']!r} / distance_m",
        "domain": {name: [ends[0], ends[-1]] for name, ends in edges.items()}
        | {"bearing_deg": [0.0, models.attrs["max_bearing_deg"]]},
        "flags": {each.name: each.meaning for each in Use},
        "warnings": warnings_of(models),
        "models": [
            {
                "configuration": configuration,
                "knots": {name: flat[name].values.tolist() for name in PREDICTORS},
                "cells": edges,
                **{name: _nulls(flat[name].isel(model=k).values)
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


def _quantity(model: xr.Dataset) -> dict[str, Any]:
    names = [Use(value).name for value in model["use"].values.ravel()]
    return {
        "sigma": _nulls(model["sigma"].values),
        "sigma_interval": [_nulls(model[f"sigma_{end}"].values) for end in ("low", "high")],
        "bias": _nulls(model["bias"].values),
        "bias_interval": [_nulls(model[f"bias_{end}"].values) for end in ("low", "high")],
        "knots_needed": model["knots"].values.tolist(),
        "exponent": _nulls(model["exponent"].values),
        "exponent_interval": [_nulls(model[f"exponent_{end}"].values) for end in ("low", "high")],
        "coverage": _nulls(model["coverage"].values),
        "camera_coverage": _nulls(model["camera_coverage"].values),
        "use": np.reshape(np.array(names, dtype=object), model["use"].shape).tolist(),
    }


def _rule(model: xr.Dataset) -> dict[str, Any]:
    """Return how the usual rule for one tag compares with sigma of z at the knots."""
    rule = RULE_M * model["distance_m"] ** 2
    ratio = (rule / model["sigma"].sel(quantity="z")).transpose(*PREDICTORS)
    return {"rule": "sigma = 0.02 d² m", "ratio_to_sigma_of_z": _nulls(ratio.values)}


def stacked(models: xr.Dataset) -> xr.Dataset:
    """Return the models with one dimension ``model`` in front, in place of those kept apart."""
    kept = kept_of(models)
    flat = models.drop_vars([name for name in kept if name in models.coords])
    flat = flat.stack(model=kept, create_index=False) if kept else flat.expand_dims("model")
    return flat.transpose("model", "quantity", *PREDICTORS, *(f"cell_{n}" for n in PREDICTORS),
                          "predictor")


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
    return [*lines, *ALWAYS]


def _covariances(flat: xr.Dataset) -> Any:
    """Yield (model, distance, side, angle, use, bias, 36 numbers) of each knot on the axis."""
    for k in range(flat.sizes["model"]):
        model, varies = flat.isel(model=k), flat.attrs["focal_size_varies"]
        for z in model["distance_m"].values:
            for angle in model["viewing_angle_deg"].values:
                sides = model["side_px"].values if varies else [model.attrs["focal_size_px_m"] / z]
                for side in sides:
                    pose = model_covariance(model, [0.0, 0.0, z], angle, side).isel(pose=0)
                    yield {
                        "model": k, "distance_m": float(z), "viewing_angle_deg": float(angle),
                        "side_px": float(side),
                        "use": [Use(each).name for each in pose["use"].values],
                        "bias": pose["bias"].values.tolist(),
                        "covariance": pose["covariance"].values.ravel().tolist(),
                    }


def _nulls(values: Any) -> Any:
    """Return an array as nested lists, NaN and infinity as None."""
    array = np.array(values)
    if array.dtype.kind == "f":
        finite, array = np.isfinite(array), array.astype(object)
        array[~finite] = None
    return array.tolist()


def _flat(values: Any) -> list[float]:
    return [float(value) for value in np.ravel(values)]


def _suffixes() -> str:
    return ", ".join(sorted(FORMATS))


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("sweep.report"), undefined=StrictUndefined,
        autoescape=False,  # noqa: S701  (source code, not HTML)
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )
    environment.filters |= {
        "numbers": _number_lines, "identifier": _identifier, "text": _one_line,
        "string": json.dumps,
    }
    return environment


def _one_line(text: Any) -> str:
    """Return text that cannot end a comment or a line."""
    plain = " ".join(str(text).split()).replace("*/", "* /")
    return plain.encode("ascii", "replace").decode().replace("\\", "/")


def _identifier(text: str) -> str:
    """Return a name that code may have.

    >>> _identifier("2 tags-v1")
    '_2_tags_v1'
    """
    name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in text)
    return name if name[:1].isalpha() else f"_{name}"


def _number_lines(values: Any, nan: str = "NaN", indent: int = 4) -> str:
    """Return numbers as source code, six a line."""
    texts = [nan if isinstance(v, float) and math.isnan(v) else repr(v) for v in values]
    lines = [", ".join(texts[k : k + 6]) for k in range(0, len(texts), 6)]
    return (",\n" + " " * indent).join(lines)


def written_error_models(data: ReportData, paths: Sequence[str]) -> xr.Dataset:
    """Write the error models of a store into files, and return them.

    Parameters
    ----------
    data
        The store.
    paths
        Files, each in the format that its suffix says: ``.json``, ``.hpp`` or ``.h`` (C++17),
        ``.py``, ``.java``, ``.yaml`` (covariances for ROS).

    Raises
    ------
    ArgumentError
        If a suffix is of no format.
    StoreError
        If a file cannot be written.
    DatasetError
        As `sweep.analysis.error_models`.
    """
    for path in paths:
        check_error_model_file(path)
        check_output_file(Path(path))
    models = models_of(data)
    texts = [error_model_text(models, facts_of(data), path) for path in paths]
    for path, text in zip(paths, texts, strict=True):
        write_output_file(Path(path), text.encode("utf-8", errors="replace"))
    return models


def models_of(data: ReportData) -> xr.Dataset:
    """Return the error models of a store; they are made once."""
    return data.once(error_models.__name__, lambda: error_models(data.results))


def facts_of(data: ReportData) -> dict[str, Any]:
    """Return what the models are of."""
    return {
        "store": data.store, "title": data.pipeline.heading,
        "camera": camera_facts(data.pipeline).line(),
        "fingerprint": dict(data.run_metadata.get("fingerprint", {})),
        "pipeline": data.pipeline.text,
    }


def selected(data: ReportData, at: Sequence[str]) -> ReportData:
    """Return the data at some values of axes that keep models apart: ``solver=ippe``.

    Raises
    ------
    ArgumentError
        For a name that is no such axis, or a value that the axis does not have.
    PipelineError
        For what is no name with a value.
    """
    results = data.results
    kept = [name for name in axes_of(results) if is_kept(name, results)]
    chosen: dict[str, Any] = {}
    for text in at:
        chosen |= parse_selection(text)
    for name, value in chosen.items():
        if name not in kept:
            raise ArgumentError("at", name, "models are kept apart by "
                                f"{', '.join(kept) or 'nothing'}; the others are pooled")
        values = results[name].values.tolist()
        equal = [k for k, each in enumerate(values) if each == value or (
            isinstance(value, float) and isinstance(each, float)
            and math.isclose(each, value, rel_tol=1e-9))]
        if not equal:
            raise ArgumentError("at", f"{name}={value}",
                                f"expected one of {', '.join(map(str, values))}")
        results = results.isel({name: equal})
    return dataclasses.replace(data, results=results) if chosen else data
