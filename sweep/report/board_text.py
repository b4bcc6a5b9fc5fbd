"""What a report says of boards: what counts as detected, and how many of their markers are."""

from __future__ import annotations

import math

from sweep.analysis import detection_rate, per_marker
from sweep.analysis.conditions import BOARDS
from sweep.plan.boards import shows_boards, target_word
from sweep.plan.parameters import Stage
from sweep.report.error_columns import RATES
from sweep.report.figure import sentences
from sweep.report.report_data import ReportData
from sweep.report.table import Table, table_of

MAX_ROWS = 40
"""The most rows of a table of all detector settings; of more it pools these."""


def detected_words(data: ReportData) -> str:
    """Return what is detected, as a clause: of a board any marker is enough."""
    word = target_word(data.pipeline)
    return f"the {word} is detected" + (", by at least one marker" if word != "marker" else "")


def board_sentence(data: ReportData) -> str:
    """Return what a reader must know of boards; empty of single markers."""
    if not shows_boards(data.pipeline):
        return ""
    axis = data.pipeline.axis_of(BOARDS)
    several = axis is not None and len(axis) > 1
    return sentences(
        "A board counts as detected if at least one of its markers is.",
        f"Limits hold with each {axis.name}; the other numbers are pooled over {axis.name}, if "
        "their table does not list it." if several and axis is not None else "",
    )


def board_tables(data: ReportData) -> list[Table]:
    """Return the rates of boards' single markers, by board and detector setting."""
    if "marker_detection" not in data.results:
        return []
    board = data.pipeline.axis_of(BOARDS)
    boards = [board.name] if board is not None and len(board) > 1 else []
    settings = [axis.name for axis in data.pipeline.axes_of(Stage.detection) if len(axis) > 1]
    if math.prod(data.length(name) for name in (*boards, *settings)) > MAX_ROWS:
        settings = []
    dims = [*boards, *settings]
    rates = data.once(("markers of boards", *dims),
                      lambda: detection_rate(per_marker(data.results), dims))
    return [table_of(
        rates, "Markers of boards, each counted by itself, with 95 % intervals", dims, RATES,
        sources=data.results)]
