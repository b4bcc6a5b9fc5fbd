"""Attributes of tables for readers: short names, and the rule by which sampling was stopped."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec

import xarray as xr

from sweep.analysis.dimensions import is_sampling_stopped, pipeline_text
from sweep.messages import shown
from sweep.plan.attributes import with_descriptions
from sweep.plan.stopping import SECTIONS
from sweep.plan.toml_text import read_document

P = ParamSpec("P")

SAMPLING = "sampling"
"""The attribute of tables of datasets whose sampling was stopped."""


def describes(analysis: Callable[P, xr.Dataset]) -> Callable[P, xr.Dataset]:
    """Return an analysis whose result has short names, and says whether sampling was stopped."""
    @functools.wraps(analysis)
    def described(*args: P.args, **kwargs: P.kwargs) -> xr.Dataset:
        table = with_descriptions(analysis(*args, **kwargs))
        return with_sampling(table, *(
            each for each in (*args, *kwargs.values()) if isinstance(each, xr.Dataset)))

    return described


def with_sampling(table: xr.Dataset, *datasets: xr.Dataset) -> xr.Dataset:
    """Return a table with the attribute :data:`SAMPLING`, if sampling of a dataset was stopped."""
    texts = dict.fromkeys(text for each in datasets if (text := sampling_text(each)))
    return table.assign_attrs({SAMPLING: "; ".join(texts)}) if texts else table


def sampling_text(results: xr.Dataset) -> str:
    """Return the rule by which a dataset's sampling was stopped; empty if it was not.

    That is ``stopped by [precision]: detection_rate = 0.02, max_trials = 2400``.
    """
    if not is_sampling_stopped(results):
        return ""
    document = read_document(pipeline_text(results))
    name = next(each for each in SECTIONS if each in document)
    keys = ", ".join(f"{key} = {shown(value)}" for key, value in document[name].items())
    return f"stopped by [{name}]: {keys}"
