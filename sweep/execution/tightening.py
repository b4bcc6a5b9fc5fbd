"""A store in waves that is continued by a stricter rule: what was computed stays."""

from __future__ import annotations

import tomllib

import tomlkit

from sweep.plan.experiment import Pipeline
from sweep.plan.stopping import MAX_TRIALS
from sweep.store.closing import reopen
from sweep.store.lifecycle import open_store
from sweep.store.lock import locked
from sweep.store.run_store import RunStore


def tighten(store: RunStore, pipeline: Pipeline) -> RunStore:
    """Give a store the rule of a pipeline of the same cells, and return the store as it is then.

    Blocks that were committed under the former rule are decided again when the store is continued,
    each from what it has.

    Raises
    ------
    StoreError
        If another process writes the store, or it cannot be written.
    """
    text = tightened_text(store.pipeline, pipeline)
    with locked(store):
        reopen(store, text)
    return open_store(store.url, "r+", durable=store.durable)


def tightened_text(begun: Pipeline, ours: Pipeline) -> str:
    r"""Return a pipeline's text with the section by which sampling stops from another pipeline.

    >>> begun, ours = (Pipeline.from_text(
    ...     "[pose]\nside_px = 20\njitter_px = 1\n[precision]\n"
    ...     f"max_trials = 90\ndetection_rate = {width}") for width in (0.1, 0.05))
    >>> print(tightened_text(begun, ours), end="")
    [pose]
    side_px = 20
    jitter_px = 1
    [precision]
    detection_rate = 0.05
    max_trials = 90
    """
    if ours.stopping is None:
        raise TypeError(ours.stopping)
    section = ours.stopping.section
    wanted = dict(tomllib.loads(ours.text)[section]) | {MAX_TRIALS: ours.stopping.max_trials}
    document = tomlkit.parse(begun.text)
    table = document[section]
    for key in list(table):  # in its place, whatever it looks like
        del table[key]
    for key in sorted(wanted):
        table[key] = wanted[key]
    return tomlkit.dumps(document)
