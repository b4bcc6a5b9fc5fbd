"""The answer of a report: what is required, judged by configuration, is what plain NumPy finds."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from support.reports import CAMERA, command, made
from support.small_datasets import perfect
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.experiment import Pipeline
from sweep.report.answer import answer
from sweep.report.figures import figure_kinds
from sweep.report.report_data import ReportData, read_report_data

SMALL = f"""title = "How far?"
{CAMERA}
[pose]
jitter_px = 0.5
[scene]
noise_grey = 2
[axes]
side_px = [8, 40]
cornerRefinementMethod = ["none", "subpix"]
trial = 4
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return made(tmp_path_factory.mktemp("small"), SMALL, "small")


NONE = "cornerRefinementMethod none"
"""How a configuration is called in a sentence."""

SIZES = {"distance_m": 4, "tilt_deg": 2, "trial": 400, "cornerRefinementMethod": 2}


def synthetic(rates, require=("detection >= 0.9",), per=("distance_m", "tilt_deg"), **belief):
    """Return data of a store with these detection rates (distance, tilt, refinement)."""
    rng = np.random.default_rng(3)
    (name, values), = belief.items() or (("solver", ["ippe_square"]),)
    results = perfect(rng, SIZES | {"solver": len(values)}).assign_coords(solver=values)
    results = results.rename({"solver": name}) if belief else results
    detected = np.arange(400)[None, None, :, None] < 400 * np.asarray(rates)[:, :, None]
    results["detection"][:] = np.where(
        detected, DetectionStatus.detected, DetectionStatus.no_candidate)
    lost = ~results["detection"].isin([DetectionStatus.detected])
    lost = lost.broadcast_like(results["estimate"]).transpose(*results["estimate"].dims)
    results["estimate"] = results["estimate"].where(~lost, EstimateStatus.no_detection)
    results["flipped"] = results["flipped"].where(~lost, Flipped.no_estimate)
    axes = "\n".join(
        f"{name} = {results[name].values.tolist()!r}".replace("'", '"')
        for name in ("distance_m", "tilt_deg", "cornerRefinementMethod", *belief))
    pipeline = Pipeline.from_text(
        f"seed = 1\n[pose]\njitter_px = 0.5\n[axes]\n{axes}\ntrial = 400\n", name="made")
    results["distance_m"].attrs["units"] = "m"
    results["tilt_deg"].attrs["units"] = "degree"
    results = results if belief else results.isel(solver=0, drop=True)
    return ReportData("made", results, pipeline, {}, require=tuple(require), per=per)


def test_the_headline_is_of_the_best_configuration_and_never_of_several_together():
    # Pooled, 3 of 4 would be detected at 0.4 m; of each configuration all or half are.
    rates = [[[1, 1], [1, 1]], [[1, 0.5], [1, 0.5]], [[1, 0.5], [0.5, 0.5]], [[0.5, 0], [0, 0]]]
    shown = answer(synthetic(rates))
    assert shown.headline == f"Yes up to 0.4 m at tilts up to 30\u00b0, with {NONE}."
    assert shown.of == NONE
    assert ("It is limited by detection_rate >= 0.9, which is 0.500 at 0.8 m and a tilt of "
            "30\u00b0." in shown.paragraph)
    (table,) = (each for each in shown.tables if each.caption.startswith("How far"))
    assert table.rows == [
        ["none", "0.8 m", "0.4 m", "detection_rate 0.500 at 0.8 m, 30\u00b0"],
        ["subpix", "0.2 m", "0.2 m", "detection_rate 0.500 at 0.4 m, 30\u00b0"]]
    assert {tile.heading: tile.value for tile in shown.tiles}["detected"] == "75.0 %"


@pytest.mark.parametrize(("near", "headline"), [
    (0.5, "No: at no distance at tilts up to 30\u00b0, with none of the configurations."),
    (0.9, (f"Perhaps up to 0.2 m (at most 0.2) at tilts up to 30\u00b0, with {NONE}: too few draws "
           "to tell.")),
    (0.88, (f"Probably not: at no distance at tilts up to 30\u00b0, with {NONE}, but there are too "
            "few draws to tell.")),
    (1, f"Yes up to 0.2 m at tilts up to 30\u00b0, with {NONE}."),
])
def test_the_answer_says_yes_perhaps_or_no(near, headline):
    rates = np.zeros((4, 2, 2))
    rates[0] = near
    assert answer(synthetic(rates)).headline == headline


def test_where_large_angles_fail_the_answer_is_of_the_smaller_ones_and_says_so():
    rates = np.ones((4, 2, 2))
    rates[:, 1] = 0.2
    rates[-1, 0, 1] = 0.2
    shown = answer(synthetic(rates))
    assert shown.headline == (
        f"Yes at all distances, up to 1.6 m (1.6 or more) at tilts up to 0\u00b0, with {NONE}.")
    assert shown.paragraph.startswith("At tilts up to 30\u00b0: at no distance.")


def test_what_is_met_between_two_values_is_said_so():
    rates = np.full((4, 2, 2), 0.2)
    rates[1:3] = 1
    shown = answer(synthetic(rates))
    assert shown.headline == "Yes from 0.4 m to 0.8 m at tilts up to 30\u00b0, with subpix."
    assert "0.200 at 1.6 m and a tilt of 30" in shown.paragraph
    assert "Not at 0.2 m: there detection_rate >= 0.9 is not met, it is 0.200." in shown.paragraph


def test_small_angles_at_which_nothing_is_met_are_named():
    rates = np.ones((4, 2, 2))
    rates[:, 0] = 0.2
    rates[2:] = 0.2
    shown = answer(synthetic(rates))
    assert shown.headline == f"Yes up to 0.4 m at a tilt of 30\u00b0, with {NONE}."
    assert shown.paragraph.startswith(
        "At tilts below 30\u00b0: at no distance (detection_rate 0.200 at 0.2 m, 0\u00b0).")


def test_angles_of_which_the_large_are_the_easy_ones_are_told_from_small_to_large():
    rates = np.ones((4, 2, 2))
    rates[:, 0] = 0.2
    shown = answer(synthetic(rates, per=("tilt_deg",)))
    assert shown.headline == "Yes only at a tilt of 30\u00b0, with subpix."


def test_without_an_ordered_condition_the_answer_is_of_all_conditions():
    rates = np.ones((4, 2, 2))
    rates[..., 1] = 0.2
    shown = answer(synthetic(rates, per=("cornerRefinementMethod",)))
    assert shown.headline == f"Yes, with {NONE}."


def test_a_wrong_belief_is_in_no_answer():
    shown = answer(synthetic(np.ones((4, 2, 2)), believed_focal_scale=[0.99, 1.0, 1.01]))
    assert shown.of == f"{NONE} \u00b7 believed_focal_scale 1.0"
    assert "wrong" not in shown.headline + shown.of
    assert "4 configurations with a wrong belief are no choice; the range bias is " in (
        shown.paragraph)
    (table,) = (each for each in shown.tables if each.caption.startswith("Which configuration"))
    assert not any("wrong" in cell for row in table.rows for cell in row)
    (table,) = (each for each in shown.tables if each.caption.startswith("What a wrong belief"))
    assert [row[0] for row in table.rows] == [
        f"none \u00b7 believed_focal_scale {scale}"
        for scale in ("1.0", "0.99 (wrong)", "1.01 (wrong)")]


def blank(_, file, **__):
    """Write a drawing that is empty, on a page; none where it would be a file."""
    if not isinstance(file, Path):
        file.write("<svg></svg>")


def test_page_markdown_json_and_terminal_have_the_same_answer(small, tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", blank)
    arguments = ["report", small, "--require", "detection >= 0.9", "--per", "side_px"]
    page, text = tmp_path / "r.html", tmp_path / "r.md"
    code, out, err = command(*arguments, "-o", page, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["required"] == ["detection_rate >= 0.9"]
    code, out, err = command(*arguments, "-o", text)
    assert (code, err) == (0, "")
    assert told["answer"] == out.splitlines()[1]
    shown = page.read_text(encoding="utf-8")
    assert re.search(r'<p class="verdict">(.*?)</p>', shown)[1] == told["answer"]
    assert f"**{told['answer']}**" in text.read_text(encoding="utf-8")
    for each in told["numbers"]:
        assert f'<span class="value">{each["value"]}</span>' in shown
        assert f"**{each['value']}**" in text.read_text(encoding="utf-8")


@pytest.mark.long
def test_origin_stands_last_and_the_command_is_the_one_that_was_given(small, tmp_path):
    page = tmp_path / "a report.html"
    given = ["report", small, "--require", "detection >= 0.5", "--per", "side_px", "-o", page]
    assert command(*given)[0] == 0
    text = page.read_text(encoding="utf-8")
    commands = re.search(r"<pre[^>]*><code>(sweep run.*?)</code>", text, re.DOTALL)[1]
    expected = shlex.join(["sweep", *map(str, given)]).replace("'", "&#39;").replace(">", "&gt;")
    assert commands.splitlines()[-1] == expected
    assert text.index('id="source"') > text.index('id="scenes"') > text.index('id="figures"')


@pytest.mark.parametrize(("arguments", "message"), [
    (["--require", "detectoin >= 0.9"], "--require detectoin >= 0.9: "),
    (["--require", "detection >= 1.2"], "--require detection >= 1.2: "),
    (["--require", "detection >= 0.9", "--per", "distanse_m"], "--per distanse_m: no such "),
])
def test_what_cannot_be_required_is_told_in_one_line(arguments, message, small, tmp_path):
    code, out, err = command("report", small, *arguments, "-o", tmp_path / "r.html")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(message)


def test_every_kind_of_axis_has_a_figure(small):
    data = read_report_data(small)
    assert [kind.name for kind in figure_kinds(data)][:3] == ["detection", "errors", "bias"]
    beliefs = synthetic(np.ones((4, 2, 2)), believed_focal_scale=[0.99, 1.0, 1.01])
    assert "effect-believed_focal_scale" in [kind.name for kind in figure_kinds(beliefs)]
