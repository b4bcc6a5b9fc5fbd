"""Parts of the page: escaped text, colours of outcomes, tables, and what is packaged with it."""

import html
import re
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.report.answer import Answer, Tile
from sweep.report.charts import (
    COLOURS,
    OUTCOME_COLOURS,
    THEME,
    Panel,
    Series,
    below_floor,
    css_variables,
    draw_lines,
    draw_stack,
    value_scale,
)
from sweep.report.figure import Figure as ReportFigure
from sweep.report.figure import interval_sentence
from sweep.report.scenes import FAILURES, Scene
from sweep.report.table import MAX_ROWS, Findings, Table
from sweep.report.write_report import Provenance, page

HOSTILE = "<script>alert('x')</script>\"&{{ 7 * 7 }}"


def hostile_table():
    return Table.of(HOSTILE, [HOSTILE] * 2, [[HOSTILE] * 2], words=True)


def hostile_page():
    figure = ReportFigure(
        "name", HOSTILE, HOSTILE, hostile_table(),
        [Panel(HOSTILE, HOSTILE, lambda axes: axes.set_xlabel(HOSTILE), wide=True)])
    scenes = [Scene((HOSTILE,), HOSTILE, HOSTILE, HOSTILE, HOSTILE, picture, problem=HOSTILE)
              for picture in (b"png", None)]
    origin = Provenance({"Store": HOSTILE, "Report": HOSTILE}, (HOSTILE,), hostile_table(),
                        HOSTILE, HOSTILE, HOSTILE)
    numbers = Answer(HOSTILE, HOSTILE, HOSTILE, (Tile(HOSTILE, HOSTILE, HOSTILE),),
                     (hostile_table(),), (hostile_table(),))
    return page(HOSTILE, numbers, origin, [figure], scenes, [HOSTILE])


def test_all_text_of_a_store_is_escaped():
    text = hostile_page()
    assert "<script" not in text
    assert "49" not in re.sub(r"<svg.*?</svg>|base64,[^\"]*", "", text, flags=re.DOTALL)
    # Title twice; kicker, tiles, captions, cells, facts, commands, scenes: every one is shown.
    assert html.unescape(text).count(HOSTILE) > 30


@pytest.mark.parametrize("dark", [False, True])
def test_the_page_has_every_colour_of_the_figures(dark):
    declared = dict(re.findall(r"--(\w+): (#\w{6});", css_variables(dark=dark)))
    assert declared == {name: colours[dark] for name, colours in THEME.items()}
    assert set(COLOURS) <= {light for light, _ in THEME.values()}
    assert f"--c1: {declared['c1']};" in hostile_page()


# Flags.

def test_every_flag_of_a_counted_pose_that_is_not_solved_is_a_kind_of_scene():
    assert [(type(flag), flag.name) for flag in FAILURES] == [
        *((DetectionStatus, name)
          for name in ("wrong_id", "rejected", "no_candidate", "failed", "crashed")),
        *((EstimateStatus, name) for name in (
            "solver_failed", "not_converged", "not_explained", "too_few_points", "failed",
            "crashed")),
    ]


def test_an_outcome_without_a_colour_of_its_own_is_hatched():
    axes = Figure().add_subplot()
    share = np.array([0.25])
    draw_stack(axes, ["all"], {"solved": share, "blinded": share, "tired": share}, "all poses")
    solved, blinded, tired = (bars.patches[0] for bars in axes.containers)
    assert solved.get_hatch() is None
    assert blinded.get_hatch()
    assert blinded.get_facecolor() != tired.get_facecolor()


def test_every_counted_outcome_of_today_has_a_colour_of_its_own():
    hatched = {"too_few_points"}  # of boards alone
    assert {flag.name for flag in FAILURES} - hatched | {"solved"} == set(OUTCOME_COLOURS)
    assert len(set(OUTCOME_COLOURS.values())) == len(OUTCOME_COLOURS)


# Tables.

def test_a_long_table_is_cut_and_says_so():
    table = Table.of("Many", ["name", "value"], [[str(k), "1"] for k in range(MAX_ROWS + 5)])
    assert len(table.shown_rows) == MAX_ROWS
    assert table.full_caption == f"Many (the first {MAX_ROWS} of {MAX_ROWS + 5} rows)"
    assert table.markdown().count("\n") == MAX_ROWS + 3


def test_every_printer_keeps_hostile_text_in_its_cell():
    nasty = "a|b\\|c\nd\re <i>f</i> `g` *h* \x1b[31m \u202e"
    table = Table.of(nasty, [nasty, "n"], [[nasty, "1"], [nasty, "2"]])
    rows = table.markdown().splitlines()[2:]
    assert len(rows) == 4
    assert {len(re.findall(r"(?<!\\)(?:\\\\)*\|", row)) for row in rows} == {3}
    assert "<i>" not in table.markdown()
    lines = table.text().splitlines()
    assert len(lines) == 5
    assert all(line.isprintable() for line in lines)
    assert table.as_json()["rows"][0] == [nasty, "1"]
    found = Findings([table, nasty, Table.of("none", ["n"], [])], {"share": float("inf")})
    assert "<i>" not in found._repr_html_() + found.markdown()
    assert str(found).startswith(table.text())
    assert "none" not in str(found)
    assert '"share_flag": "infinite"' in found.to_json()


@pytest.mark.parametrize(("values", "scale"), [
    (np.geomspace(0.05, 1, 8), "log"), (np.array([0.5, 1, 2, 4]), "log"),
    (np.linspace(3, 57, 10), "linear"), (np.linspace(0, 60, 4), "linear"),
    (np.array([1.0, 10.0]), "log"), (np.array([10.0, 12.0, 14.0]), "linear"),
], ids=["geom", "doubled", "bins of a tilt", "with 0", "two", "short"])
def test_values_that_grow_by_factors_are_on_a_logarithmic_axis(values, scale):
    axes = Figure().subplots()
    ones = np.ones(len(values))
    draw_lines(axes, [Series("", values, ones, ones, ones)], ("x", "y"))
    assert axes.get_xscale() == scale


def test_errors_of_rounding_do_not_compress_the_others():
    none = np.full(4, np.nan)
    y = np.array([1e-14, 0.02, 0.5, 3.0])
    assert below_floor(y)
    assert not below_floor(y[1:])
    logarithmic, (low, high) = value_scale([Series("", np.arange(4.0), y, none, none)], share=False)
    assert logarithmic
    assert 1e-3 < low < 0.02
    assert 3 < high < 10
    assert not value_scale([Series("", np.arange(4.0), y, none, none)], share=False, level=0.0)[0]


def test_intervals_are_said_to_be_over_what_was_drawn():
    summary = xr.Dataset({"rate_low": 0.1, "rate_high": 0.9})
    for coordinates, words in (
        ({}, "over the random draws, conditional on the grid."),
        ({"photographs": "shots"}, "over the photographs, each with all its markers one draw."),
    ):
        data = SimpleNamespace(results=xr.Dataset(coords=coordinates))
        assert interval_sentence(data, summary).endswith(words)
        none = interval_sentence(data, summary + np.nan)
        assert ("photographs" in none) == bool(coordinates)
