"""The tradeoff of a finished store: what each configuration costs, and how accurate it is."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import covariance_trust, efficiency, renderer_bias
from sweep.analysis.comparisons import corners_of
from sweep.analysis.dataset import computed_scenes
from sweep.analysis.summaries import guarded_error_statistics
from sweep.errors import ArgumentError, StoreError
from sweep.execution.progress import StageReport
from sweep.experiment.experiment import distinct, used_settings, wrong_configurations
from sweep.experiment.grid import TRIAL, Axis
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Interrupts
from sweep.measure.estimators import build
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.messages import nearest
from sweep.plugins.loading import printing_to_stderr
from sweep.plugins.recording import is_recording
from sweep.store.lifecycle import open_dataset, open_store, unfinished_line, write_group
from sweep.store.lock import changing
from sweep.store.provenance import differences
from sweep.tradeoff.costs import (
    Indices,
    any_process_interval,
    measure,
    measure_renderers,
    median_interval,
    sample_scenes,
    whole_frames_of,
)
from sweep.tradeoff.pareto import WRONG, WRONG_BELIEF, configuration_label
from sweep.typing import Floats

#: Values and the low and high ends of their intervals, arrays of one shape.
Interval = tuple[Floats, Floats, Floats]

#: Share of the time limit that is left for the costs, however long the accuracy takes.
MIN_SHARE = 0.3

#: The renderer with which others are compared if the grid has several.
REFERENCE = "exact"


def measure_trade(
    url: str, per: Sequence[str] = (), limit_s: float = 60.0,
    progress: StageReport | None = None, *, question: Mapping[str, str | float] | None = None,
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Measure the tradeoff of a finished store, and write it to its group ``cost/tradeoff``.

    Each configuration, a combination of detector and estimator settings, has its costs, measured
    here (`sweep.tradeoff.costs.measure`), and its accuracy in the store
    (:func:`sweep.analysis.error_statistics`; upper ends of RMSE also hold rare errors that no draw
    showed). The first configuration is the baseline.

    Parameters
    ----------
    url
        A finished store.
    per
        Scene axes; each combination of their values is a condition of its own. Axes of targets
        (markers, boards, dictionaries) always are.
    limit_s
        Time limit of the measurement in seconds, in which the accuracy is read, too, as far as it
        leaves 30 % of them.
    progress
        Called with the current step, and the share of it that is done.
    question
        Options of the tradeoff, ``criterion`` and ``budget_ms``: kept in its attributes for
        the report.

    Returns
    -------
    trade
        Dimensions ``per`` and ``treatment``, the configurations by label. If renderers are an axis,
        of ``exact`` images alone.
    renderers
        If renderers are an axis, what each costs, and what it changes against ``exact`` images
        (also written, to ``cost/renderers``); else None.

    Raises
    ------
    StoreError
        If there is no finished store, it has no results, or it was made with other versions.
    ArgumentError
        If ``per`` names no axis of the scenes, or there is no time.
    """
    if not 0 < limit_s < math.inf:
        raise ArgumentError("limit_s", limit_s, "expected a finite number above 0")
    started = time.perf_counter()
    store = open_store(url, "r+")
    if not store.finished:
        raise StoreError(unfinished_line(store))
    stored, results = store.pipeline, open_dataset(url)
    for plugin in stored.plugins:
        if is_recording(plugin.name):
            raise StoreError(
                f"{url}: the detections of {plugin.name} were recorded: there is no search whose "
                "time could be measured"
            )
    per = list(dict.fromkeys((*per, *(axis.name for axis in stored.experiment.target_axes))))
    _check(url, stored, results, per)
    # The same versions and files must be measured as were run.
    pipeline = Pipeline.from_text(
        stored.text, name=stored.name, source=url, folder=stored.folder,
    )
    lines = differences(pipeline, stored, store.fingerprint)
    if lines:
        raise StoreError("\n".join([f"{url}: its costs cannot be measured here:", *lines]))
    renderers = None
    report = progress or (lambda _what, _share: None)
    with contextlib.ExitStack() as stack:
        stack.enter_context(changing(url, store.storage))
        interrupts = stack.enter_context(Interrupts())
        if pipeline.plugins:
            stack.enter_context(printing_to_stderr())
        if "renderer" in results.dims:
            names = [str(name) for name in results["renderer"].values.tolist()]
            report("measuring renderers", 0.0)
            renderers = _renderers(pipeline, results, names, limit_s / 4, interrupts)
            pipeline = dataclasses.replace(
                pipeline, fixed={**pipeline.fixed, "renderer": REFERENCE},
                axes=tuple(axis for axis in pipeline.axes if axis.name != "renderer"),
            )
            results = results.sel(renderer=REFERENCE, drop=True)
        trade = _trade(pipeline, results, per, started + limit_s, limit_s, interrupts, report)
        trade.attrs.update(question or {})
        if renderers is not None:
            write_group(store, "cost/renderers", renderers)
        write_group(store, "cost/tradeoff", trade)
    return trade, renderers


def _check(url: str, pipeline: Pipeline, results: xr.Dataset, per: Sequence[str]) -> None:
    """Raise an error if the tradeoff cannot be measured by the axes ``per``."""
    axes = [axis.name for axis in pipeline.axes_of(Stage.scene) if axis.name != TRIAL]
    for name in per:
        if name == TRIAL:
            raise ArgumentError("per", TRIAL, "trials are draws, over which the intervals are")
        if name not in axes:
            known = nearest(name, axes) or f"; there are {', '.join(axes) or 'none'}"
            raise ArgumentError("per", name, f"no axis of the scene{known}")
    if results["estimate"].size == 0:
        raise StoreError(f"{url}: there are no results")
    if "renderer" in per:
        raise ArgumentError("per", "renderer", "renderers are compared with exact in any case")
    if "renderer" in axes and REFERENCE not in results["renderer"].values.tolist():
        raise StoreError(
            f"{url}: renderers are compared with {REFERENCE}, which is not among them: "
            "add it to the axis"
        )


def _trade(
    pipeline: Pipeline, results: xr.Dataset, per: Sequence[str], deadline: float, limit_s: float,
    interrupts: Interrupts, report: StageReport,
) -> xr.Dataset:
    """Return the trade, measured until a time of `time.perf_counter` of at most ``limit_s``."""
    report("reading the accuracy", 0.0)
    axes = [*pipeline.axes_of(Stage.detection), *pipeline.axes_of(Stage.estimation)]
    settings = [axis.name for axis in axes]
    kept = [*per, *settings]
    nees = results.get("nees", xr.DataArray(np.nan)) * _corner_noise_scale(pipeline, results, per)
    accuracy = xr.merge(
        [
            guarded_error_statistics(results, kept),
            efficiency(results, kept),
            covariance_trust(results.assign(nees=nees), kept),
            _bound(results, per),
        ],
        compat="no_conflicts", join="exact",
    ).compute()
    trade = _flattened(pipeline, accuracy, axes)
    lengths = [results.sizes[name] for name in per]
    conditions = list(np.ndindex(*lengths))
    configurations = trade.sizes["treatment"]
    measuring = (
        f"measuring {configurations:,} configuration{'s' if configurations > 1 else ''} under "
        f"{len(conditions):,} condition{'s' if len(conditions) > 1 else ''}"
    )
    report(measuring, 0.0)
    samples = [
        _without_crashed(pipeline, results, [
            sample_scenes(pipeline, dict(zip(per, condition, strict=True)), len(conditions))
        ])[0]
        for condition in conditions
    ]
    costs = measure(
        pipeline, samples, max(deadline - time.perf_counter(), MIN_SHARE * limit_s), interrupts,
        lambda share: report(measuring, share),
    )

    def add(name: str, meaning: str, unit: str, interval: Interval) -> None:
        shaped = [np.asarray(end).reshape(*lengths, configurations) for end in interval]
        _add(trade, (*per, "treatment"), name, meaning, unit, shaped)

    total = costs.total
    add("cost_ms", "detection and estimation of a frame", "ms", median_interval(1e3 * total))
    add("cost_ratio", "cost over the baseline's", "1", any_process_interval(costs.ratio))
    each = np.broadcast_to(costs.detection[..., None], total.shape)
    add("detection_ms", "detection of a frame", "ms", median_interval(1e3 * each))
    add("estimation_ms", "estimation of a frame", "ms", median_interval(1e3 * costs.estimation))
    whole = whole_frames_of(pipeline)
    trade = trade.isel(treatment=distinct(pipeline, _settings(axes)))
    trade.attrs = {
        "title": pipeline.heading,
        "poses": int(computed_scenes(results).sum()),
        "window": "full" if all(whole) else "auto" if not any(whole) else "mixed",
        "baseline": str(trade["treatment"].values[0]),
        "rounds": len(total),
        "frames": int(np.nansum(costs.frames)),
        "sampled": sum(len(sample[0]) if sample else 1 for sample in samples),
        "covariance": "of the solvers with the corners' noise as it was measured under each "
                      "condition; of photometric from its likelihood",
    }
    return trade


def _without_crashed(
    pipeline: Pipeline, results: xr.Dataset, samples: Sequence[Sequence[Indices]]
) -> list[list[Indices]]:
    """Return samples without the scenes that crashed their process in the run.

    Samples are paired: a scene that is left out of one is left out of all.

    Raises
    ------
    StoreError
        If all scenes crashed.
    """
    names = [axis.name for axis in pipeline.axes_of(Stage.scene)]
    dead = np.zeros(len(samples[0][0]) if names else 1, dtype=bool)
    for indices in samples:
        at = {name: xr.DataArray(index, dims="cell")
              for name, index in zip(names, indices, strict=True)}
        for name, status in (("detection", DetectionStatus), ("estimate", EstimateStatus)):
            crashed = results[name].isel(at) == status.crashed
            dead |= crashed.any([dim for dim in crashed.dims if dim != "cell"]).to_numpy()
    if dead.all():
        raise StoreError("each scene that would be timed crashed its process in the run")
    return [[index[~dead] for index in indices] for indices in samples]


def _add(
    table: xr.Dataset, dims: Sequence[str], name: str, meaning: str, unit: str,
    interval: Sequence[Any],
) -> None:
    """Add a variable and the ends of its 95 % interval to a dataset."""
    for ending, words, values in zip(
        ("", "_low", "_high"),
        ("", ", lower end of the 95 % interval", ", upper end of the 95 % interval"),
        interval, strict=True,
    ):
        table[name + ending] = (dims, values, {"long_name": meaning + words, "units": unit})


def _settings(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """Return the value along each axis of every combination, the last axis fastest."""
    names = [axis.name for axis in axes]
    return [dict(zip(names, chosen, strict=True))
            for chosen in itertools.product(*(axis.values for axis in axes))]


def _flattened(
    pipeline: Pipeline, accuracy: xr.Dataset, axes: Sequence[Axis]
) -> xr.Dataset:
    """Return a dataset with one dimension ``treatment``, by label, for the settings' axes.

    Those with a wrong belief are marked: they show what an error costs, and are no choices.
    """
    names = [axis.name for axis in axes]
    wrong = wrong_configurations(pipeline, axes)
    labels = [
        configuration_label(used_settings(pipeline, values)) + WRONG * believed_wrongly
        for values, believed_wrongly in zip(_settings(axes), wrong, strict=True)
    ]
    if not axes:
        return accuracy.expand_dims(treatment=labels)
    flat = accuracy.stack(treatment=names, create_index=False)
    flat = flat.assign_coords(treatment=("treatment", labels))
    marks = {WRONG_BELIEF: ("treatment", np.array(wrong))} if any(wrong) else {}
    return flat.assign_coords(marks)


def _bound(results: xr.Dataset, per: Sequence[str]) -> xr.Dataset:
    """Return the RMS bound of rotation and range over the poses with a bound."""
    bound = results["bound_std"].astype(np.float64).load()
    over = [dim for dim in bound.dims if dim not in (*per, "pose_parameter")]
    turns = bound.sel(pose_parameter=[f"rotation_{axis}" for axis in "xyz"])
    turn = (turns**2).sum("pose_parameter", skipna=False).mean(over) ** 0.5
    depth = bound.sel(pose_parameter="translation_z", drop=True) / results["true_tvec_m"].sel(
        xyz="z", drop=True
    ).load()
    shift = (depth**2).mean(over) ** 0.5
    return xr.Dataset(
        {
            "bound_rotation_deg": (turn * (180 / np.pi)).assign_attrs(
                long_name="RMS bound of the rotation error", units="degree"),
            "bound_range_percent": (100 * shift).assign_attrs(
                long_name="RMS bound of the depth error, of the true depth", units="percent"),
        }
    )


def _corner_noise_scale(
    pipeline: Pipeline, results: xr.Dataset, per: Sequence[str]
) -> xr.DataArray:
    """Return the factor from squared deviations under the assumed to the measured corner noise.

    1 for estimators whose covariance does not come from the corners' noise. Those of a chessboard's
    points have the noise of its corners, all others that of markers' corners.
    """
    searched = [axis.name for axis in pipeline.axes_of(Stage.detection)]
    axes = pipeline.axes_of(Stage.estimation)
    estimators = pipeline.experiment.estimators

    def measured(name: str) -> xr.DataArray:
        error = results[name].astype(np.float64)
        over = [dim for dim in error.dims if dim not in (*per, *searched)]
        return (error**2).mean(over).compute()

    def over_estimators(values: Sequence[Any], kind: type) -> xr.DataArray:
        names = [axis.name for axis in axes]
        return xr.DataArray(
            np.array(values, dtype=kind).reshape([len(axis) for axis in axes]), dims=names,
            coords={name: results[name] for name in names})

    noise = measured(corners_of(results))
    chessboard = [setting.points == "chessboard" for setting in estimators]
    if any(chessboard):
        noise = noise.where(
            ~over_estimators(chessboard, bool), measured("chessboard_corner_error_px"))
    # None, an estimator without such a noise, is NaN.
    assumed = over_estimators([setting.corner_noise_px for setting in estimators], float)
    from_images = over_estimators([build(setting).needs_images for setting in estimators], bool)
    return (assumed**2 / noise).where(~from_images, 1.0)


def _renderers(
    pipeline: Pipeline, results: xr.Dataset, names: Sequence[str], limit_s: float,
    interrupts: Interrupts,
) -> xr.Dataset:
    """Return the cost of each renderer, and what it changes against exact images."""
    samples = _without_crashed(pipeline, results, [
        sample_scenes(pipeline, {"renderer": number}, len(names)) for number in range(len(names))
    ])
    reference = names.index(REFERENCE)
    seconds, rms, largest = measure_renderers(pipeline, samples, reference, limit_s, interrupts)
    changed = renderer_bias(results, REFERENCE).compute()
    _add(changed, ("renderer",), "render_ms", "rendering of an image", "ms",
         median_interval(1e3 * seconds))
    _add(changed, ("renderer",), "render_ratio", "cost over that of exact", "1",
         any_process_interval(seconds / seconds[:, [reference]]))
    for name, meaning, values in (
        ("grey_rms", "RMS difference of the marker's pixels from the exact image's", rms),
        ("grey_max", "largest difference from the exact image", largest),
    ):
        changed[name] = ("renderer", values, {"long_name": meaning, "units": "grey level"})
    changed.attrs = {"title": pipeline.heading, "reference": REFERENCE}
    return changed
