"""Plug-ins are used once before a run: one that cannot work refuses it, and costs no pose."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from sweep.errors import PluginError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.measure.detectors import make_detector
from sweep.measure.estimators import PluggedEstimatorSetting, build
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, estimators
from sweep.plan.scene_plugins import scene_plugins
from sweep.plugins.declared import PluginSetting

LIMIT_S = 60.0
"""Seconds that a plug-in may take to be made, and to search one blank frame."""

MAX_SETTINGS = 16
"""Settings of a plug-in that are tried."""


def check_plugins(child: Child, pipeline: Pipeline, limit_s: float = LIMIT_S) -> None:
    """Use each of a pipeline's plug-ins in a child process, which goes on to work.

    Raises
    ------
    PluginError
        If one cannot be imported or made, raises on a blank frame, ends its process, or does not
        return; in one line.
    """
    for plugin in pipeline.plugins:
        name = f"{plugin.kind} {plugin.name}"
        try:
            child.call(use, pipeline, plugin.kind, plugin.name, limit_s=limit_s)
        except ChildDiedError as error:
            child.restart()
            raise PluginError(f"{name}: ends its process before the first pose: {error}") from None
        except ChildRaisedError as error:
            raise PluginError(f"{name}: {last_line(error)}") from None


@single_threaded()
def use(pipeline: Pipeline, kind: str, name: str) -> None:
    """Import a plug-in and make it with each of its settings; a detector searches a blank frame.

    Raises
    ------
    PluginError
        If that cannot be done.
    """
    if kind == "detector":
        width, height = (min(pipeline.values_of(side)) for side in ("width_px", "height_px"))
        blank = np.full((height, width), 128, dtype=np.uint8)
        settings = [
            setting for setting in detector_settings(pipeline)
            if isinstance(setting, PluginSetting) and setting.plugin.name == name
        ]
        for setting in _first(settings):
            search = make_detector(setting)
            for dictionary in _first(pipeline.values_of("dictionary")):
                search(blank, dictionary, max(width, height))
    elif kind == "estimator":
        for estimator in _first(
            each for each in estimators(pipeline)
            if isinstance(each, PluggedEstimatorSetting) and each.solver == name
        ):
            build(estimator)
    else:
        scene_plugins(pipeline)


def _first(values: Iterable[object]) -> list[Any]:
    return list(dict.fromkeys(values))[:MAX_SETTINGS]
