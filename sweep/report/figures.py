"""The figures that a report can have, in the order in which they stand."""

from __future__ import annotations

from collections.abc import Iterator

from sweep.report.figure import FigureKind
from sweep.report.report_data import Subject
from sweep.report.scene_figures import (
    DETECTION,
    ERRORS_BY_SIZE,
    FAILURES,
    FLIPS,
    MAPS,
    RANKING,
    effect_of,
)
from sweep.report.treatment_figures import BOUND, COMPARED, TRADE, TREATMENTS

KINDS: tuple[FigureKind, ...] = (
    DETECTION, ERRORS_BY_SIZE, MAPS, FAILURES, FLIPS, RANKING, TREATMENTS, COMPARED, BOUND, TRADE,
)
"""Add a kind of figure here; an axis that none of them covers gets a figure of its effect."""


def figures_of(subject: Subject) -> Iterator[FigureKind]:
    """Yield the kinds of figures that apply to a store; no axis of it is only pooled."""
    covered: set[str] = set()
    for kind in KINDS:
        if kind.applies(subject):
            covered.update(kind.covers(subject))
            yield kind
    for name in (*subject.scene_axes, *subject.treatments):
        if name not in covered:
            yield effect_of(name)
