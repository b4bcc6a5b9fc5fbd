"""The answer of a report is what plain NumPy finds; error models as JSON by the guide's reader."""

import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from support.pose_errors import poses_with_law, power_law, reader_of_the_guide
from support.reports import command, made
from support.small_datasets import perfect, with_detected
from sweep.analysis import compare, error_models, error_statistics, model_errors
from sweep.analysis.error_models import Use
from sweep.analysis.requirements import Decision
from sweep.experiment.pipeline import Pipeline
from sweep.report.findings import error_model_document, error_model_table
from sweep.report.report_data import ReportData
from sweep.report.table import number, to_json
from sweep.report.write_report import answer
from sweep.store.lifecycle import open_dataset

GUIDE = (Path(__file__).parents[2] / "pipelines" / "README.md").read_text(encoding="utf-8")
TUTORIAL = re.search(r"<!-- file: mine.toml -->\n```toml\n(.*?)```", GUIDE, re.DOTALL)[1]

def blank(_, file, **__):
    """Write a drawing that is empty, as text on a page and as bytes of a file."""
    if not isinstance(file, Path):
        file.write("<svg></svg>" if isinstance(file, io.StringIO) else b"")


@pytest.fixture(autouse=True)
def _undrawn(monkeypatch):
    """Draw no figures: the answers do not depend on them."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", blank)


def told(url, *arguments):
    """Return a report's answer as JSON, and its page."""
    page = Path(url).parent / "report.html"
    code, out, err = command("report", url, "-o", page, "--json", *arguments)
    assert (code, err) == (0, "")
    return json.loads(out), page.read_text(encoding="utf-8")


def value_of(cell):
    """Return the number of a cell of a table's JSON, infinite where it is flagged."""
    return math.inf if cell.get("value_flag") == "infinite" else cell["value"]


def test_line_table_json_and_page_have_the_numbers_of_the_analysis(tmp_path):
    url = made(tmp_path, TUTORIAL, "tutorial",
               settings=["distance_m=[1, 3, 5]", "tilt_deg=[30, 60]", "trial=12"])
    shown, page = told(url)
    results = open_dataset(url)
    assert shown["answer"].startswith("subpix against none: ")
    assert f'<p class="verdict">{shown["answer"]}</p>' in page
    table = next(each for each in shown["tables"]
                 if each["caption"].startswith("Configurations, with"))
    rows = {row["configuration"]: row for row in table["rows"]}
    found = error_statistics(results, ["cornerRefinementMethod"])
    for label, row in rows.items():
        one = found.sel(cornerRefinementMethod=label)
        assert row["n"] == one["looked_for"]
        for heading, name, scale in (
            ("solved, %", "solved_rate", 100), ("rotation RMSE, deg", "rotation_rmse_deg", 1),
            ("rotation median, deg", "rotation_median_deg", 1),
            ("range RMSE, %", "range_rmse_percent", 1)):
            assert value_of(row[heading]) == pytest.approx(scale * one[name].item(), rel=1e-9)
    tiles = {each["name"]: each for each in shown["numbers"]}
    assert tiles["detected"]["text"] == f"{number(rows['subpix']['detected, %']['value'])} %"
    assert tiles["range RMSE"]["value"] == rows["subpix"]["range RMSE, %"]["value"]
    (pair,) = shown["comparison"]
    assert (pair["configuration"], pair["against"]) == ("subpix", "none")
    sides = (results.sel(cornerRefinementMethod=label) for label in ("none", "subpix"))
    difference = compare(*sides)["detection_difference"].item()
    assert pair["differences"][0]["value"] == pytest.approx(100 * difference)
    for each in pair["differences"]:
        kind = each["quantity"].split()[0]
        cell = next(cell for heading, cell in rows["none"].items()
                    if heading.startswith(kind) and ("difference" in heading or "ratio" in heading))
        assert cell["value"] == each["value"]
        equal = 0 if "difference" in each["quantity"] else 1
        decided = each["verdict"] in {"better", "worse"}
        assert decided == (not each["low"] <= equal <= each["high"])
        if decided:
            assert (f"{each['quantity']} {number(each['value'])} ({number(each['low'])} to "
                    f"{number(each['high'])})") in shown["answer"]
            assert (each["value"] > equal) == ((each["verdict"] == "better") == (equal == 0))


@pytest.mark.parametrize(("axis", "start"), [
    ("quiet_zone_modules = [0.5, 1, 2]", "quiet_zone_modules "),
    ("light = { zip = { white = [200, 255], noise_grey = [8, 2] } }", "light "),
    ('tag = { zip = { dictionary = ["DICT_4X4_50", "DICT_5X5_50"], marker_id = [7, 9] } }', "tag "),
])
def test_what_varies_alone_is_compared_not_averaged(axis, start, tmp_path):
    url = made(tmp_path, "pose = { side_px = 40, jitter_px = 0.5 }\n[axes]\n"
               f"{axis}\ntrial = 20\n", "alone")
    shown, _ = told(url)
    assert shown["answer"].startswith(start)
    assert " against " in shown["answer"]
    assert ("draws of their own" in shown["text"]) == (start != "light ")
    assert shown["per"] == ([] if start == "light " else [start.strip()])


def test_the_cheapest_is_left_to_what_measures_costs(tmp_path):
    url = made(tmp_path, "pose = { side_px = 40, jitter_px = 0.5 }\n"
               'require.all = ["detection >= 0.5"]\nsearch = { cheapest = true, max_trials = 20 }\n'
               "axes.adaptiveThreshConstant = [2, 7]\n", "cheapest")
    assert told(url)[0]["answer"].endswith(
        f", by 2 of 2 configurations; the cheapest is named by `sweep size {url}`.")


SIZES = {"distance_m": 4, "tilt_deg": 2, "trial": 400, "cornerRefinementMethod": 2}


def synthetic(rates, require=("detection >= 0.9",), per=("distance_m", "tilt_deg"), **belief):
    """Return data of a store with these detection rates (distance, tilt, refinement)."""
    rng = np.random.default_rng(3)
    (name, values), = belief.items() or (("solver", ["ippe_square"]),)
    results = perfect(rng, SIZES | {"solver": len(values)}).assign_coords(solver=values)
    results = results.rename({"solver": name}) if belief else results
    detected = np.arange(400)[None, None, :, None] < 400 * np.asarray(rates)[:, :, None]
    results = with_detected(results, detected)
    axes = "\n".join(
        f"{name} = {results[name].values.tolist()!r}".replace("'", '"')
        for name in ("distance_m", "tilt_deg", "cornerRefinementMethod", *belief))
    pipeline = Pipeline.from_text(
        f"seed = 1\n[pose]\njitter_px = 0.5\n[axes]\n{axes}\ntrial = 400\n", name="made")
    results["distance_m"].attrs["units"] = "m"
    results["tilt_deg"].attrs["units"] = "degree"
    results = results if belief else results.isel(solver=0, drop=True)
    return ReportData("made", results, pipeline, {}, require=tuple(require), per=per)


def all_tilts(rates):
    """Return these rates (distance, refinement) at both tilts."""
    return np.repeat(np.asarray(rates, float)[:, None, :], 2, axis=1)


@pytest.mark.parametrize(("rates", "named", "decision", "reached"), [
    (all_tilts([[1, 1], [1, 0.5], [0.5, 0.5], [0, 0]]), "none", "not_met",
     "at all values of tilt_deg: up to 0.4 m (0.4)"),
    (np.zeros((4, 2, 2)), "", "not_met", "at all values of tilt_deg: at no value"),
    (np.full((4, 2, 2), 0.91), "", "undecided", "up to 1.6 m"),
    (all_tilts([[0, 0], [0, 1], [0, 1], [0, 0]]), "subpix", "not_met", "0.4 to 0.8 m (0.8)"),
    (np.stack([np.ones((4, 2)), np.full((4, 2), 0.2)], axis=1), "", "not_met",
     "at no value; at tilt_deg=0: at all values, up to 1.6 m"),
], ids=["found", "never", "too few", "within", "one angle"])
def test_what_is_required_is_decided_with_how_far_and_the_configuration(
    rates, named, decision, reached
):
    shown = answer(synthetic(rates))
    assert shown.of == named or (not named and shown.of in {"none", "subpix"})
    assert shown.headline.endswith(f", with {shown.of}.")
    assert reached in shown.headline
    assert shown.numbers["decision"] is Decision[decision]
    words = {"not_met": "not met", "undecided": "not decided"}[decision]
    assert shown.headline.startswith(f"detection >= 0.9: {words} at ")
    together, by_angle = shown.tables[:2]
    assert together.frame["cornerRefinementMethod"].tolist() == ["none", "subpix"]
    assert set(together.frame["decided"]) <= {True, False}
    assert len(by_angle.frame) == 4


def test_the_table_of_limits_has_a_dip_and_an_open_interval():
    shown = answer(synthetic(all_tilts([[1, 0.91], [0.2, 0.91], [1, 0.2], [0.2, 0.2]])))
    rows = {row[0]: row for row in shown.tables[0].rows}
    assert rows["none"][1:4] == ["up to 0.2 m", "0.2", "yes"]
    assert rows["none"][5] == "0.8 m"
    assert rows["subpix"][1:4] == ["not decided: up to 0.4 m", "below 0.2 to 0.4", "no"]


def test_without_an_axis_the_worst_value_is_told():
    for rate, words in ((0.9, "not decided (0.900 ("), (1.0, "met (1.00 (")):
        shown = answer(synthetic(np.full((4, 2, 2), rate), per=("cornerRefinementMethod",)))
        assert shown.headline.startswith(f"detection >= 0.9: {words}")


def test_a_wrong_belief_is_never_named():
    beliefs = {"believed_focal_scale": [0.99, 1.0, 1.01]}
    for require in ((), ("detection >= 0.9",)):
        shown = answer(synthetic(np.ones((4, 2, 2)), require, **beliefs))
        assert shown.of.endswith("believed_focal_scale 1.0")
        assert "wrong" not in shown.headline
    (table,) = (each for each in shown.tables if each.caption.startswith("Configurations, with"))
    assert sum("(wrong)" in row[0] for row in table.rows) == 4


TITLE = 'a " */ quote\\ \n #include <x> {{ 7 * 7 }} {% raw %} """ \u2028 </script> \udcff'
ABOUT = {"store": 'runs/"odd" */ name.zarr', "title": TITLE, "fingerprint": {}}


@pytest.fixture(scope="module")
def models():
    axes = {"distance_m": [1.0, 2.0, 4.0], "tilt_deg": [0.0, 30.0, 60.0], "solver": ["a", TITLE],
            "trial": list(range(60))}
    return error_models(poses_with_law(8, axes, power_law, bearing_deg=20.0))


@pytest.fixture(scope="module")
def document(models):
    text = to_json(error_model_document(models, ABOUT))
    assert text.isascii()
    return json.loads(text, parse_constant=pytest.fail)


def test_the_reader_of_the_guide_gives_the_same_numbers(models, document):
    """Within and around the region, rounding apart."""
    rng = np.random.default_rng(1)
    z = np.exp(rng.uniform(np.log(0.9), np.log(4.5), 150))
    z[:3] = 1.0, 2.0, 4.0
    x, y = rng.uniform(-0.5, 0.5, (2, 150)) * z
    angle = rng.uniform(-5, 80, 150)
    angle[:3] = 0.0, 30.0, 60.0
    x[:3] = y[:3] = 0.0
    read = reader_of_the_guide()
    bearing = np.degrees(np.arctan2(np.hypot(x, y), z))
    wanted = [model_errors(models.isel(solver=k), z, angle, None, bearing) for k in (0, 1)]
    unseen = 0
    for n, (solver, *position) in enumerate(zip(np.arange(150) % 2, x, y, z, strict=True)):
        found = read(document["models"][solver], *position, angle[n])
        unseen += math.isnan(found["z"]["sigma"])
        for quantity, each in found.items():
            one = wanted[solver].isel(pose=n).sel(quantity=quantity)
            for name in ("sigma", "bias"):
                np.testing.assert_allclose(each[name], one[name], rtol=1e-9, atol=1e-15)
            assert each["use"] == Use(int(one.use)).name
    assert 20 < unseen < 130
    assert math.isnan(read(document["models"][0], 0.0, 0.0, 0.0, 0.0)["z"]["sigma"])
    assert math.isnan(read(document["models"][0], 0.0, 0.0, -2.0, 0.0, 74.25)["z"]["sigma"])


def test_the_table_compares_the_usual_rule(models):
    table = error_model_table(models)
    assert table.headings[0] == "solver"
    assert {row[0] for row in table.rows} == {"a", TITLE}
    assert {row[table.headings.index("held-out check")] for row in table.rows} == {"few draws"}
    shown = table.as_json()["rows"][0]
    assert shown["0.02 d² / sigma z"]["value"] == pytest.approx(
        20 * shown["distance, m"] ** 2 / shown["z, mm"]["value"], rel=1e-3)
