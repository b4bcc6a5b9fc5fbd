"""The report: what it tells is what the store holds, whatever the store, and nothing else."""

import base64
import contextlib
import html
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.reports import CAMERA, FULL, command, made
from sweep.analysis import ambiguity, detection_rate, error_statistics, failure_composition
from sweep.report.report_data import read_report_data
from sweep.report.table import number
from sweep.report.write_report import figures_of
from sweep.store.lifecycle import open_dataset, open_store

ODD = {
    "nothing detected": f"{CAMERA}[pose]\njitter_px = 0.5\n[axes]\nside_px = [3, 4]\n"
                        "tilt_deg = [0, 60]\ntrial = 3\n",
    "nothing visible": f"{CAMERA}[pose]\ntilt_deg = 180\n[axes]\nside_px = [20, 40]\n",
    "single pose": f"{CAMERA}[pose]\nside_px = 40\n",
    "a wanted precision": f"{CAMERA}[pose]\ntilt_deg = {{ uniform = [0, 60] }}\n[axes]\n"
                          'side_px = [8, 40]\nsolver = ["ippe"]\n[search]\nmax_trials = 100\n'
                          "precision.detection_rate = 0.2\n",
    "one draw": f"{CAMERA}[pose]\nside_px = 40\ntilt_deg = {{ uniform = [0, 60] }}\n",
    "lists and words": f"{CAMERA}[pose]\nside_px = 40\njitter_px = 0.5\n[axes]\n"
                       'distortion = [[], [-0.1, 0.01, 0, 0]]\nrenderer = ["exact", "warp"]\n'
                       "guarded = [true, false]\ntrial = 3\n",
}
NO_DRAWS = f"""title = "All <axes> & kinds"
{CAMERA}
[axes]
side_px = [20, 40]
solver = ["ippe", "iterative"]
"""


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    return made(tmp_path_factory.mktemp("full"), FULL, "full")


@pytest.fixture(scope="module")
def page(full, tmp_path_factory):
    output = tmp_path_factory.mktemp("page") / "report.html"
    code, out, err = command("report", full, "-o", output)
    assert (code, err) == (0, "")
    assert out.startswith(f"{output}: ")
    return output.read_text(encoding="utf-8")


def texts(tags, part):
    """Return the texts of elements with some tags in a part of a page."""
    found = re.findall(rf"<(?:{tags})\b[^>]*>(.*?)</(?:{tags})>", part, re.DOTALL)
    return [html.unescape(re.sub(r"<.*?>", "", text)).strip() for text in found]


def tables_of(page):
    """Return the rows of a page's tables by caption: the texts of their cells."""
    tables = re.findall(r"<table.*?</table>", page, re.DOTALL)
    return {texts("caption", table)[0]: [
        texts("th|td", row) for row in re.findall(r"<tr.*?</tr>", table, re.DOTALL)]
        for table in tables}


def test_the_page_needs_nothing_else(page, full):
    ids = re.findall(r' id="([^"]*)"', page)
    references = re.findall(
        r' (?:src|href|xlink:href|action|data|poster|srcset)="([^"]*)"', page)
    assert all(value.startswith(("data:", "#")) for value in references)
    assert {value[1:] for value in references if value.startswith("#")} <= set(ids)
    assert len(ids) == len(set(ids))
    assert not re.search(r"url\((?!#|data:|['\"]data:)", page)
    assert not re.search(r"<script|@import|javascript:|\son\w+=", page)
    assert "default-src 'none'" in html.unescape(page)
    assert "http" not in re.sub(r"http-equiv|<pre.*?</pre>", "", page, flags=re.DOTALL)
    encoded = re.search(r'href="data:application/toml;base64,([^"]*)"', page)[1]
    assert base64.b64decode(encoded).decode() == open_store(full).pipeline.text


def test_the_page_can_be_read_by_those_who_cannot_see_it(page):
    images = re.findall(r"<img\b[^>]*>", page)
    assert '<html lang="en">' in page
    assert "<title>All &lt;axes&gt; &amp; &#34;kinds&#34; of $figures$</title>" in page
    assert page.count("<h1>") == 1
    assert "<svg" not in page
    assert len(images) > 9
    assert all(re.search(r' alt="[^"]', image) for image in images)
    assert len(tables_of(page)) > 7
    assert all('scope="' in heading for heading in re.findall(r"<th\b[^>]*>", page))


@pytest.mark.parametrize("name", ODD)
def test_odd_stores_have_a_report_without_a_warning(name, tmp_path):
    output = tmp_path / "report.html"
    url = made(tmp_path, ODD[name], "odd")
    assert command("report", url, "-o", output)[::2] == (0, "")
    text = output.read_text(encoding="utf-8")
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"<pre.*?</pre>", "", text))
    assert {path.name for path in tmp_path.iterdir()} == {"odd.zarr", "report.html"}
    assert "finished" in command("status", url)[1]
    assert command("plan", url)[0] == 0
    if name == "nothing visible":
        assert command("report", url, "-o", tmp_path / "report.md")[0] == 0


def test_numbers_of_the_tables_are_those_of_the_analysis(full, page):
    tables, results = tables_of(page), open_dataset(full)
    one = results.sel(cornerRefinementMethod="none", solver="photometric")
    shares, kept = (analysis(one, ["side_px"]) for analysis in (failure_composition, ambiguity))
    errors = error_statistics(one, ["tilt_deg", "side_px"])
    rates = detection_rate(one, ["marker_id"])

    def shown(words, heading, *label):
        rows = next(rows for caption, rows in tables.items() if caption.startswith(words))
        row = next(row for row in rows if row[: len(label)] == list(map(str, label)))
        return row[rows[0].index(heading)].split(" (")[0]

    label = "none \u00b7 photometric"
    for side in (7, 40):
        assert shown("Outcomes", "share, %", label, "solved", side) == number(
            100 * float(shares["share"].sel(side_px=side, outcome="solved")))
        assert shown("Thresholds", "solved", label, side) == str(int(
            kept["solved"].sel(side_px=side)))
        assert shown("Rates and errors", "rotation median, deg", label, 50, side) == number(
            float(errors["rotation_median_deg"].sel(tilt_deg=50, side_px=side)))
    assert shown("IDs", "detected, %", "none", 7) == number(
        100 * float(rates["detection_rate"].sel(marker_id=7)))


def test_markdown_has_its_figures_beside_it_and_figures_go_where_they_are_asked(tmp_path):
    url = made(tmp_path, NO_DRAWS, "plain")
    output, folder, mine = (tmp_path / name for name in ("answer.md", "pictures", "mine"))
    folder.mkdir()
    mine.write_text("mine")
    names = [figure.name for figure in figures_of(read_report_data(url))]
    for name in names:  # nothing is written through a link that waits
        (folder / f"{name}.svg").symlink_to(mine)
    code, out, err = command("report", url, "-o", output, "--figures", folder)
    assert (code, err, mine.read_text()) == (0, "", "mine")
    assert out.startswith(f"{output}: {len(names)} figures")
    text = output.read_text(encoding="utf-8")
    assert text.startswith("# All &lt;axes&gt; &amp; kinds\n")
    linked = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text)
    assert len(linked) > len(names)  # scenes, too
    for link in linked:
        encoded = (tmp_path / link).read_bytes()
        assert cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR) is not None
    for name in names:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        ET.parse(folder / f"{name}.svg")  # noqa: S314  (our own file)


def test_a_report_is_never_written_into_a_store(tmp_path):
    url = made(tmp_path, ODD["single pose"], "one")
    link = tmp_path / "link"
    link.symlink_to(url)
    hidden = tmp_path / "hidden_figures"
    hidden.symlink_to(Path(url) / "cost")

    def held():
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    before = held()
    with contextlib.chdir(tmp_path):
        for arguments in (
            ("-o", "one.zarr/../one.zarr/a.html"), ("-o", link / "a.html"),
            ("--figures", url), ("-o", "hidden.md"),
        ):
            code, out, err = command("report", url, *arguments)
            assert (code, out, len(err.splitlines())) == (2, "", 1)
            assert "cannot be written: it is inside the store" in err
    assert held() == before
