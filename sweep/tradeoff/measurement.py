"""The tradeoff of a finished store: what each configuration costs, and how accurate it is."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import covariance_trust, efficiency, renderer_bias
from sweep.analysis.dataset import computed_scenes
from sweep.analysis.estimator import INTERVAL
from sweep.analysis.summaries import guarded_error_statistics
from sweep.errors import ArgumentError, StoreError, texts_of
from sweep.execution.progress import StageReport
from sweep.experiment.experiment import distinct, used_settings, wrong_configurations
from sweep.experiment.grid import TRIAL, Axis
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Interrupts
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.messages import nearest
from sweep.plugins.loading import is_recording, printing_to_stderr
from sweep.store.lifecycle import open_dataset, open_finished, write_groups
from sweep.store.lock import changing
from sweep.store.provenance import differences
from sweep.tradeoff import costs
from sweep.tradeoff.pareto import WRONG, WRONG_BELIEF, configuration_label
from sweep.typing import Floats

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
        If there is no finished store, or it was made with other versions.
    ArgumentError
        If ``per`` names no axis of the scenes.
    """
    started = time.perf_counter()
    store = open_finished(url, "r+")
    stored, results = store.pipeline, open_dataset(url)
    for plugin in stored.plugins:
        if is_recording(plugin.name):
            raise StoreError(
                f"{url}: the detections of {plugin.name} were recorded: there is no search whose "
                "time could be measured"
            )
    targets = (axis.name for axis in stored.experiment.target_axes)
    per = list(dict.fromkeys((*texts_of("per", per), *targets)))
    _check(url, stored, results, per)
    # The same versions and files must be measured as were run.
    pipeline = Pipeline.from_text(stored.text, name=stored.name, source=url, folder=stored.folder)
    if lines := differences(pipeline, stored, store.fingerprint):
        raise StoreError("\n".join([f"{url}: its costs cannot be measured here:", *lines]))
    renderers = None
    report = progress or (lambda _what, _share: None)
    # Plug-ins may print.
    with changing(url, store.storage), Interrupts() as interrupts, printing_to_stderr():
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
        write_groups(store, {"cost/tradeoff": trade} | (
            {} if renderers is None else {"cost/renderers": renderers}))
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
    kept = [*per, *(axis.name for axis in axes)]
    trade, settings = _flattened(pipeline, xr.merge([
        guarded_error_statistics(results, kept), efficiency(results, kept),
        covariance_trust(results, kept)], compat="no_conflicts", join="exact"), axes)
    conditions = list(np.ndindex(*(results.sizes[name] for name in per)))
    measuring = (f"measuring configurations ({len(settings):,}) under conditions "
                 f"({len(conditions):,})")
    report(measuring, 0.0)
    samples = [
        _without_crashed(pipeline, results, [
            costs.sample_scenes(pipeline, dict(zip(per, condition, strict=True)), len(conditions))
        ])[0]
        for condition in conditions
    ]
    timed = costs.measure(
        pipeline, samples, max(deadline - time.perf_counter(), MIN_SHARE * limit_s), interrupts,
        lambda share: report(measuring, share),
    )
    detection = np.broadcast_to(timed.detection[..., None], timed.total.shape)
    for name, meaning, unit, interval in (
        ("cost_ms", "detection and estimation of a frame", "ms",
         costs.median_interval(1e3 * timed.total)),
        ("cost_ratio", "cost over the baseline's", "1", costs.any_process_interval(timed.ratio)),
        ("detection_ms", "detection of a frame", "ms", costs.median_interval(1e3 * detection)),
        ("estimation_ms", "estimation of a frame", "ms",
         costs.median_interval(1e3 * timed.estimation)),
    ):
        _add(trade, (*per, "treatment"), name, meaning, unit, interval)
    whole = costs.whole_frames_of(pipeline)
    return trade.isel(treatment=distinct(pipeline, settings)).assign_attrs({
        "title": pipeline.heading,
        "poses": int(computed_scenes(results).sum()),
        "window": "full" if all(whole) else "auto" if not any(whole) else "mixed",
        "baseline": str(trade["treatment"].values[0]),
        "rounds": len(timed.total),
        "frames": int(np.nansum(timed.frames)),
        "sampled": sum(len(sample[0]) if sample else 1 for sample in samples),
    })


def _without_crashed(
    pipeline: Pipeline, results: xr.Dataset, samples: Sequence[Sequence[costs.Indices]]
) -> list[list[costs.Indices]]:
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
    interval: Sequence[Floats],
) -> None:
    """Add a variable and the ends of its 95 % interval to a dataset."""
    for (ending, words), values in zip(INTERVAL.items(), interval, strict=True):
        table[name + ending] = (
            dims, np.reshape(values, [table.sizes[dim] for dim in dims]),
            {"long_name": words + meaning, "units": unit})


def _flattened(
    pipeline: Pipeline, accuracy: xr.Dataset, axes: Sequence[Axis]
) -> tuple[xr.Dataset, list[dict[str, Any]]]:
    """Return a dataset with one dimension ``treatment``, by label, for the settings' axes.

    With it the settings of each. Those with a wrong belief are marked: they show what an error
    costs, and are no choices.
    """
    names = [axis.name for axis in axes]
    settings = [dict(zip(names, values, strict=True))
                for values in itertools.product(*(axis.values for axis in axes))]
    wrong = wrong_configurations(pipeline, axes)
    labels = [configuration_label(used_settings(pipeline, values)) + WRONG * believed_wrongly
              for values, believed_wrongly in zip(settings, wrong, strict=True)]
    flat = accuracy.stack(treatment=names, create_index=False) if axes else (
        accuracy.expand_dims("treatment"))
    marks = {WRONG_BELIEF: ("treatment", np.array(wrong))} if any(wrong) else {}
    return flat.assign_coords({"treatment": ("treatment", labels), **marks}), settings


def _renderers(
    pipeline: Pipeline, results: xr.Dataset, names: Sequence[str], limit_s: float,
    interrupts: Interrupts,
) -> xr.Dataset:
    """Return the cost of each renderer, and what it changes against exact images."""
    samples = _without_crashed(pipeline, results, [
        costs.sample_scenes(pipeline, {"renderer": k}, len(names)) for k in range(len(names))
    ])
    reference = names.index(REFERENCE)
    seconds, rms, largest = costs.measure_renderers(
        pipeline, samples, reference, limit_s, interrupts)
    changed = renderer_bias(results, REFERENCE)
    _add(changed, ("renderer",), "render_ms", "rendering of an image", "ms",
         costs.median_interval(1e3 * seconds))
    _add(changed, ("renderer",), "render_ratio", "cost over that of exact", "1",
         costs.any_process_interval(seconds / seconds[:, [reference]]))
    for name, meaning, values in (
        ("grey_rms", "RMS difference of the marker's pixels from the exact image's", rms),
        ("grey_max", "largest difference from the exact image", largest),
    ):
        changed[name] = ("renderer", values, {"long_name": meaning, "units": "grey level"})
    return changed.assign_attrs(title=pipeline.heading, reference=REFERENCE)
