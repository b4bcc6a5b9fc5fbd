"""The report: what it tells is what the store holds, whatever the store, and nothing else."""

import base64
import contextlib
import dataclasses
import functools
import html
import math
import re
import shutil
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.reports import CAMERA, FULL, command, made
from sweep.analysis import (
    detection_rate,
    error_statistics,
    failure_composition,
)
from sweep.errors import StoreError
from sweep.measure.flags import EstimateStatus
from sweep.report.figures import figures_of
from sweep.report.report_data import ReportData, read_report_data
from sweep.report.scenes import scenes_of
from sweep.report.table import number
from sweep.report.write_report import write_report
from sweep.store.lifecycle import open_dataset, open_store

ODD = {
    "single pose": f"{CAMERA}[pose]\nside_px = 40\n",
    "nothing detected": f"{CAMERA}[pose]\njitter_px = 0.5\n[axes]\nside_px = [3, 4]\n"
                        "tilt_deg = [0, 60]\ntrial = 3\n",
    "nothing visible": f"{CAMERA}[pose]\ntilt_deg = 180\n[axes]\nside_px = [20, 40]\n",
    "no draws": f"{CAMERA}[axes]\nside_px = [20, 40]\ntilt_deg = [0, 30]\n"
                'solver = ["ippe", "iterative"]\n',
    "lists and words": f"{CAMERA}[pose]\nside_px = 40\njitter_px = 0.5\n[axes]\n"
                       'distortion = [[], [-0.1, 0.01, 0, 0]]\nrenderer = ["exact", "warp"]\n'
                       "guarded = [true, false]\ntrial = 3\n",
    "distances drawn": f"{CAMERA}[pose]\ndistance_m = {{ uniform = [0.1, 0.9] }}\n[axes]\n"
                       'dictionary = ["DICT_4X4_50", "DICT_6X6_50"]\nmarker_id = [0, 1]\n'
                       "trial = 20\n",
    "places": f"{CAMERA}[pose]\nmarker_yaw_deg = 180\n[axes]\nmarker_x_m = [0.3, 0.6, 1.2]\n",
}


def opened(url, trade=None):
    data = read_report_data(url)
    return data if trade is None else dataclasses.replace(data, trade=trade)


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    return made(tmp_path_factory.mktemp("full"), FULL, "full")


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Return the store of an odd pipeline, which is computed once and must not be changed."""
    folder = tmp_path_factory.mktemp("odd")
    return functools.cache(lambda name: made(folder, ODD[name], name.replace(" ", "_")))


@pytest.fixture(scope="module")
def page(full, tmp_path_factory):
    output = tmp_path_factory.mktemp("page") / "report.html"
    code, out, err = command("report", full, "-o", output)
    assert (code, err) == (0, "")
    assert out.startswith(f"{output}: ")
    return output.read_text(encoding="utf-8")


class Page(HTMLParser):
    """A page's tags, what they refer to, and its tables by caption."""

    VOID = frozenset({"meta", "img", "br", "link", "input"})

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.references, self.tables, self.faults = [], [], [], {}, []
        self.cells = self.caption = None
        self.images = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        self.references += [
            (name, named[name])
            for name in ("src", "href", "xlink:href", "action", "data", "poster", "srcset")
            if name in named
        ]
        if "id" in named:
            self.ids.append(named["id"])
        if tag in {"img", "svg"}:
            self.images.append((tag, named))
        if tag == "table":
            self.cells, self.caption = [], None
        if tag == "tr":
            self.cells.append([])
        if tag in {"th", "td", "caption"}:
            self.text = ""
            if tag == "th" and named.get("scope") not in {"col", "row"}:
                self.faults.append("a heading of a table without scope")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> closes something else")
        if tag in {"th", "td"}:
            self.cells[-1].append(self.text)
        if tag == "caption":
            self.caption = self.text
        if tag == "table":
            self.tables.setdefault(self.caption, self.cells)

    def handle_data(self, data):
        self.text = getattr(self, "text", "") + data


def test_the_page_needs_nothing_else(page):
    read = Page(page)
    assert read.open == []
    assert read.faults == []
    for name, value in read.references:
        assert value.startswith(("data:", "#")), (name, value[:80])
    fragments = {value[1:] for _, value in read.references if value.startswith("#")}
    assert fragments <= set(read.ids)
    assert len(read.ids) == len(set(read.ids))
    assert not re.search(r"url\((?!#|data:|['\"]data:)", page)
    assert not re.search(r"<script|@import|javascript:|\son\w+=", page)
    assert "default-src 'none'" in html.unescape(page)
    assert "http" not in re.sub(r"http-equiv|<pre.*?</pre>", "", page, flags=re.DOTALL)


def kinds(url):
    return [figure.name for figure in figures_of(opened(url))]


@pytest.mark.parametrize("name", ODD)
def test_odd_stores_have_a_report_without_a_warning(name, odd, tmp_path):
    url = odd(name)
    output = tmp_path / "report.html"
    assert command("report", url, "-o", output)[::2] == (0, "")
    text = output.read_text(encoding="utf-8")
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"<pre.*?</pre>", "", text))
    read = Page(text)
    assert (read.open, read.faults) == ([], [])
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".report")]


def test_numbers_of_the_tables_are_those_of_the_analysis(full, page):
    tables = Page(page).tables
    results = open_dataset(full)
    per = ("cornerRefinementMethod", "solver", "tilt_deg", "side_px")
    errors = error_statistics(results, per).compute()
    rows = tables["Errors, with 95 % intervals"]
    assert len(rows) == 1 + errors["looked_for"].size
    column = rows[0].index("rotation median, deg")
    for row in rows[1:]:
        one = errors.sel(dict(zip(
            per, [*row[0].split(" \u00b7 "), float(row[1]), float(row[2])], strict=True)))
        low, value, high = (
            float(one[f"rotation_median_deg{end}"]) for end in ("_low", "", "_high"))
        assert row[3] == f"{int(one.looked_for):,}"
        between = "" if math.isnan(low) and math.isnan(high) else (
            f" ({number(low)} to {number(high)})")
        assert row[column] == number(value) + between
    first = re.search("the weakest first: (\\w+)", page)[1]
    rates = detection_rate(
        results.sel(cornerRefinementMethod=first), per=("marker_id",)).compute()
    rows = tables["IDs by detection rate, with 95 % intervals"]
    for row in rows[1:]:
        rate = 100 * float(rates["detection_rate"].sel(marker_id=int(row[0])))
        assert row[2].split(" (")[0] == number(rate)
    shares = failure_composition(
        results.sel(cornerRefinementMethod="none", solver="photometric"), per=("side_px",)
    ).compute()
    rows = tables["Outcomes, with 95 % intervals"]
    column = rows[0].index("share, %")
    chosen = [row for row in rows[1:] if row[0] == "none \u00b7 photometric"]
    assert {"solved"} < {row[1] for row in chosen}
    for row in chosen:
        share = 100 * float(shares["share"].sel(side_px=float(row[2]), outcome=row[1]))
        assert row[column].split(" (")[0] == number(share)


def test_the_table_of_thresholds_is_that_of_plain_counting(full, page):
    results = open_dataset(full).load()
    rows = Page(page).tables[
        "Thresholds on the ambiguity, with 95 % intervals; wanted: 1 % flips"]
    for row in rows[1:]:
        refinement, solver = row[0].split(" \u00b7 ")
        one = results.sel(
            cornerRefinementMethod=refinement, solver=solver, side_px=float(row[1]))
        solved = (one["estimate"] == EstimateStatus.solved).values
        flipped = solved & (one["flipped"] == 2).values
        error, other = (one[name].values for name in (
            "reprojection_error_px", "alternative_reprojection_error_px"))
        same = (error == 0) & (other == 0)  # nothing tells the two solutions apart
        kept = solved & ~same & ~(error > np.float64(0.2) * other)  # NaN: no other solution
        assert row[2:4] == [f"{solved.sum():,}", f"{flipped.sum():,}"]
        share = 100 * kept.sum() / solved.sum() if solved.any() else math.nan
        assert row[4].split(" (")[0] == number(share)
        assert row[5] == f"{(kept & flipped).sum():,}"
        rejected = solved & ~kept
        right = 100 * (rejected & ~flipped).sum() / rejected.sum() if rejected.any() else math.nan
        assert row[6].split(" (")[0] == number(right)
    assert 'alt="Flips kept: ' in page
    assert "Flips kept, threshold" not in page
    assert sum(int(row[2]) for row in rows[1:]) == (
        results["estimate"] == EstimateStatus.solved).sum()


# Scenes.


def test_a_scene_s_command_shows_it(full, tmp_path):
    pipeline = tmp_path / "full.toml"
    pipeline.write_text(open_store(full).pipeline.text, encoding="utf-8")
    scene = next(scenes_of(opened(full)))
    at = re.fullmatch(r"sweep show full.toml --at '?([^']*)'?", scene.command)[1]
    code, out, err = command("show", pipeline, "--at", at, "-o", tmp_path / "scene.png")
    assert (code, err) == (0, "")
    assert out.splitlines()[0].endswith(": detected, solved")


# Trade, Markdown, files.


def test_markdown_has_its_figures_beside_it_and_figures_go_where_they_are_asked(full, tmp_path):
    output, folder, mine = (tmp_path / name for name in ("answer.md", "pictures", "mine"))
    folder.mkdir()
    mine.write_text("mine")
    for name in kinds(full):  # nothing is written through a link that waits
        (folder / f"{name}.svg").symlink_to(mine)
    code, out, err = command("report", full, "-o", output, "--figures", folder)
    assert (code, err, mine.read_text()) == (0, "", "mine")
    assert out.startswith(f"{output}: {len(kinds(full))} figures")
    text = output.read_text(encoding="utf-8")
    assert text.startswith('# All &lt;axes&gt; &amp; "kinds" of \\$figures\\$\n')
    linked = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text)
    assert len(linked) >= 9 + 4
    for link in linked:
        encoded = (tmp_path / link).read_bytes()
        assert cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR) is not None
    for name in kinds(full):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        ET.parse(folder / f"{name}.svg")  # noqa: S314  (our own file)
    for line in text.splitlines():
        if line.startswith("|") and "---" not in line:
            assert re.sub(r"\\.", "", line).count("|") >= 3


def test_the_pipeline_can_be_taken_from_the_page(full, page):
    encoded = re.search(r'href="data:application/toml;base64,([^"]*)"', page)[1]
    assert base64.b64decode(encoded).decode() == open_store(full).pipeline.text


# What cannot be.

def test_a_report_is_never_written_into_a_store(tmp_path):
    url = made(tmp_path, ODD["single pose"], "one")
    other = made(tmp_path, ODD["single pose"], "other")
    link = tmp_path / "link"
    link.symlink_to(url)
    hidden = tmp_path / "hidden_figures"
    hidden.symlink_to(Path(url) / "cost")

    def held():
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    before = held()
    with contextlib.chdir(tmp_path):
        for arguments in (
            ("-o", f"{url}/zarr.json"), ("-o", f"{url}/cost/report.html"), ("-o", url),
            ("-o", "one.zarr/../one.zarr/zarr.json"), ("-o", link / "zarr.json"),
            ("-o", f"{other}/zarr.json"), ("--figures", f"{url}/figs"), ("--figures", url),
            ("--figures", link), ("-o", "hidden.md"),
        ):
            code, out, err = command("report", url, *arguments)
            assert (code, out, len(err.splitlines())) == (2, "", 1)
            assert "cannot be written: it is inside the store" in err
        for option in ("--output", "--figures"):
            assert command("report", url, option, "")[::2] == (2, f"{option} '': expected a name\n")
    assert held() == before


def chunks_of(url, name):
    return sorted(path for path in (Path(url) / name / "c").rglob("*") if path.is_file())


def test_poses_that_are_missing_are_told(odd, tmp_path):
    url = shutil.copytree(odd("no draws"), str(tmp_path / "lost.zarr"))
    output = tmp_path / "report.html"
    chunks_of(url, "detection")[0].unlink()
    code, _, err = command("report", url, "-o", output)
    assert code == 2
    assert "1 of 4 blocks lack chunks" in err
    assert "sweep verify --repair" in err
    assert not output.exists()


def test_a_report_is_whole_or_not_there(full, tmp_path, monkeypatch):
    output = tmp_path / "report.html"
    output.write_text("the one before")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("sweep.report.write_report.page", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_report(opened(full), output)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert output.read_text() == "the one before"


def test_results_without_poses_are_refused(full, tmp_path):
    data = opened(full)
    empty = ReportData(data.store, data.results.isel(trial=slice(0, 0)), data.pipeline,
                       data.run_metadata)
    with pytest.raises(StoreError, match="there are no results"):
        write_report(empty, tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


def test_the_page_can_be_read_by_those_who_cannot_see_it(page):
    read = Page(page)
    assert '<html lang="en">' in page
    assert "<title>All &lt;axes&gt; &amp; &#34;kinds&#34; of $figures$</title>" in page
    assert read.images
    for tag, attributes in read.images:
        assert tag == "img"
        assert attributes.get("alt")
    assert read.tables
    assert None not in read.tables
    assert page.count("<h1>") == 1
