"""Parts of the page: escaped text, colours, tables, what is packaged; its file, written whole."""

import html
import re
import stat

import numpy as np
import pytest
from matplotlib.figure import Figure

from sweep.errors import StoreError
from sweep.report.figure import Figure as ReportFigure
from sweep.report.output_file import check_output_file, write_output_file
from sweep.report.scenes import Scene
from sweep.report.table import MAX_ROWS, Bin, Column, Findings, Table, Value
from sweep.report.write_report import Answer, page

HOSTILE = "<script>alert('x')</script>\"&{{ 7 * 7 }}"


def hostile_table():
    return Table.of(HOSTILE, [HOSTILE] * 2, [[HOSTILE] * 2], words=True)


def hostile_page():
    figure = ReportFigure(
        "name", HOSTILE, HOSTILE, Table.of(HOSTILE, [HOSTILE, "n"], [[HOSTILE, 1.0]]),
        [Column("n", "n")])
    scenes = [Scene([HOSTILE], HOSTILE, HOSTILE, HOSTILE, picture) for picture in (b"png", None)]
    origin = {"facts": {"Store": HOSTILE, "Report": HOSTILE}, "commands": [HOSTILE],
              "pipeline": HOSTILE, "file": HOSTILE}
    tile = dict.fromkeys(("name", "text", "detail"), HOSTILE)
    numbers = Answer(HOSTILE, HOSTILE, HOSTILE, [tile],
                     (hostile_table(),), (hostile_table(),))
    return page(HOSTILE, numbers, origin, [figure], scenes, [HOSTILE])


def test_all_text_of_a_store_is_escaped():
    text = hostile_page()
    assert "<script" not in text
    assert "49" not in re.sub(r"<svg.*?</svg>|base64,[^\"]*", "", text, flags=re.DOTALL)
    # Title twice; kicker, tiles, captions, cells, facts, commands, scenes: every one is shown.
    assert html.unescape(text).count(HOSTILE) > 30


def test_a_long_table_is_cut_and_says_so():
    table = Table.of("Many", ["name", "value"], [[str(k), "1"] for k in range(MAX_ROWS + 5)])
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
    assert table.as_json()["rows"][0] == {nasty: nasty, "n": "1"}
    found = Findings([table, nasty, Table.of("none", ["n"], [])], {"share": float("inf")})
    assert "<i>" not in found._repr_html_() + found.markdown()
    assert str(found).startswith(table.text())
    assert "none" not in str(found)
    assert '"share_flag": "infinite"' in found.to_json()


def test_a_cell_is_the_same_number_in_text_and_json():
    table = Table.of("Cells", ["x, m", "bin", "rate", "n", "yes", "none"], [
        [0.5, Bin(1.0, 4.0), Value(0.25, 0.125, np.inf), 1200, True, None]])
    assert table.rows == [["0.5", "1\u20134", "0.250 (0.125 to \u221e)", "1,200", "yes", ""]]
    assert table.as_json()["rows"] == [{
        "x, m": 0.5, "bin": {"low": 1.0, "high": 4.0}, "n": 1200, "yes": True, "none": None,
        "rate": {"value": 0.25, "low": 0.125, "high": np.inf}}]


RATE = Column("rate, %", "rate", 100)


def drawn(table, x="", by="", **options):
    """Return the axes of each panel of a figure of the rate."""
    shown = ReportFigure("f", "F", "", table, [RATE], x, by, **options)
    axes = [Figure().subplots() for _ in shown.panels]
    for panel, each in zip(shown.panels, axes, strict=True):
        panel.draw(each)
    return [panel.title for panel in shown.panels], axes


def test_numbers_are_lines_with_a_panel_for_what_is_neither_x_nor_line():
    table = Table.of("Rates", ["configuration", "tilt, deg", "side, px", RATE.heading], [
        [name, tilt, Bin(side, 2 * side), Value(side, side - 1, side + 1)]
        for name in ("none", "subpix") for tilt in (0, 60) for side in (40, 10, 20)], stub=3)
    titles, panels = drawn(table, "side, px", "configuration")
    assert titles == ["Rate, tilt 0\u00b0", "Rate, tilt 60\u00b0"]
    for axes in panels:
        lines = [line for line in axes.lines if len(line.get_xdata())]
        assert [line.get_label() for line in lines] == ["none", "subpix"]
        assert lines[0].get_xdata().tolist() == [np.sqrt(2) * side for side in (10, 20, 40)]
        assert lines[0].get_ydata().tolist() == [10, 20, 40]
        assert axes.get_ylim() == (-3, 103)


def test_names_are_rows_of_dots_never_joined_and_marked_ones_are_diamonds():
    table = Table.of("Rates", ["target", RATE.heading, "weak"], [
        ["a", Value(10), False], ["b", Value(np.nan), False], ["c", Value(30), True]])
    for x in ("", "target"):
        (title,), (axes,) = drawn(table, x, by="weak")
        assert title == "Rate"
        assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b", "c"]
        dots = [line for line in axes.lines if len(line.get_xdata())]
        assert {line.get_linestyle() for line in dots} == {"None"}
        assert [(line.get_marker(), line.get_xdata().tolist()) for line in dots] == [
            ("o", [10.0]), ("D", [30.0])]


def told(path):
    """Return the one line that a path is refused with, before and while it is written."""
    lines = set()
    for refused in (check_output_file, lambda path: write_output_file(path, b"new")):
        with pytest.raises(StoreError) as error:
            refused(path)
        lines.add(str(error.value))
    assert len(lines) == 1
    return lines.pop()


def test_an_existing_file_is_replaced_at_once_and_keeps_its_mode(tmp_path):
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    path.chmod(0o640)
    with path.open("rb") as held:
        check_output_file(path)
        write_output_file(path, b"new")
        assert held.read() == b"old"
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_and_its_file_is_written(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    link = tmp_path / "link.html"
    link.symlink_to(folder / "real.html")
    for content in (b"first", b"second"):
        check_output_file(link)
        write_output_file(link, content)
        assert link.is_symlink()
        assert (folder / "real.html").read_bytes() == content
    assert len(list(folder.iterdir())) == 1


def test_what_cannot_be_written_is_told_in_a_line(tmp_path):
    file, loop = tmp_path / "file", tmp_path / "loop"
    file.write_text("mine")
    loop.symlink_to(loop)
    for path, line in {
        tmp_path: "it is a folder; choose a file in it",
        tmp_path / "none" / "file": f"folder {tmp_path / 'none'} not found",
        file / "x": f"folder {file} not found",
        loop: "Too many levels of symbolic links",
        tmp_path / ("x" * 300): "File name too long",
        tmp_path / "a\0b": "embedded null byte",
    }.items():
        assert told(path).endswith(f": cannot be written: {line}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "loop"]
