"""``sweep compare``: its table, its JSON, and what it refuses."""

import json

import numpy as np
import pytest
from matplotlib.figure import Figure

import sweep
from support.board_photographs import POSES, write_set
from support.photograph_results import results_of, twins
from support.reports import command
from sweep.analysis import simulation_gap
from sweep.report.comparison_tables import gap_figures, gap_lines, gap_table
from sweep.report.figure import panels_file


def test_the_table_has_a_row_for_each_statistic_configuration_and_bin():
    rng = np.random.default_rng(1)
    first, second = results_of(rng), twins(rng)
    gap = simulation_gap(first, second, bins={"side_px": [20, 40, 70]})
    table = gap_table(gap)
    assert list(table.headings) == [
        "statistic", "cornerRefinementMethod", "side_px", "photographs", "simulated",
        "compared by", "gap"]
    assert len(table.rows) == 7 * 2 * 2
    row = next(row for row in table.rows
               if row[:3] == ["range bias, %", "subpix", "20\u201340"])
    at = gap.sel(cornerRefinementMethod="subpix").isel(side_px=0)
    assert float(row[3].replace("\u2212", "-")) == pytest.approx(
        at.range_bias_percent.values[0], rel=0.01)
    assert "to" in row[6]
    assert gap_lines(gap) == ["12 photographs and their twins, pairs of markers"]
    few = simulation_gap(results_of(rng, 3), second)
    assert gap_lines(few)[-1] == "fewer than 5 photographs: errors without intervals"


def test_the_figure_has_the_distributions_of_both_sources():
    rng = np.random.default_rng(3)
    first, second = results_of(rng), twins(rng, scale=0.5)
    figures = gap_figures(first, second)
    assert [figure.name for figure in figures] == ["rotation", "depth"]
    panels = figures[0].panels
    assert [panel.title for panel in panels] == [
        f"Share of solved poses, cornerRefinementMethod {name}" for name in ("none", "subpix")]
    axes = Figure().add_subplot()
    panels[0].draw(axes)
    solved = first.sel(cornerRefinementMethod="none").rotation_error_rad.values.reshape(-1, 3)
    angles = np.sort(np.degrees(np.linalg.norm(solved[~np.isnan(solved[:, 0])], axis=1)))
    real, simulated = axes.lines[0], axes.lines[2]
    assert np.allclose(real.get_xdata(), np.percentile(angles, real.get_ydata()))
    assert np.median(simulated.get_xdata()) < np.median(angles)
    assert b"<svg" in panels_file(panels[:1], ".svg")


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Two stores of one pipeline, one of them with another seed, and one of two refinements."""
    text = "[pose]\nside_px = 40\njitter_px = 0.5\n[axes]\ntrial = 2\n"
    refined = text + 'cornerRefinementMethod = ["none", "subpix"]\n'
    folder = tmp_path_factory.mktemp("stores")
    for name, made in (("a", text), ("b", text), ("c", "seed = 2\n" + text), ("d", refined)):
        sweep.run(sweep.Pipeline.from_text(made), store=folder / f"{name}.zarr")
    return folder


def test_two_stores_of_a_pipeline_are_compared(stores):
    code, out, err = command("compare", stores / "a.zarr", stores / "b.zarr", "--json")
    assert (code, err) == (0, "")
    said = json.loads(out)
    assert said["fingerprint"] == []
    (one,) = said["detection"]
    assert (one["compared"], one["another flag"]) == (2, 0)
    (one,) = said["corners"]
    assert one["compared"] == 8
    assert one["worst, px"]["value"] is None
    code, out, _ = command("compare", stores / "a.zarr", stores / "b.zarr")
    assert code == 0
    assert "next: sweep report" in out


@pytest.mark.parametrize(("other", "flags", "named"), [
    ("c.zarr", [], "seeds 0 and 2"), ("d.zarr", [], "cornerRefinementMethod"),
    ("none.zarr", [], "none.zarr"), ("b.zarr", ["--bins", "side_px=1,2"], "--bins"),
    ("s.toml", ["-o", "gap.gif"], "expected a file that ends in .png or .svg"),
    ("s.toml", ["--bins", "side_px=a,b"], "--bins side_px=a,b: expected"),
])
def test_what_is_no_pair_is_refused_in_one_line(other, flags, named, stores):
    code, out, err = command("compare", stores / "a.zarr", stores / other, *flags)
    assert (code, out) == (2, "")
    assert named in err
    assert err.count("\n") == 1


def test_photographs_are_simulated_and_compared_in_one_command(tmp_path):
    shots = write_set(tmp_path, POSES)
    given = ["--camera", tmp_path / "camera.json", "--board", tmp_path / "board.toml"]
    scene = tmp_path / "same.toml"
    scene.write_text("[scene]\nblack = 35\nwhite = 210\nblur_px = 0.6\nnoise_grey = 2\n")
    code, *_ = command(
        "photos", shots, *given, "--store", tmp_path / "shots.zarr",
        "--set", 'cornerRefinementMethod=["none", "subpix"]',
    )
    assert code == 0
    code, out, _ = command("compare", tmp_path / "shots.zarr", scene)
    assert code == 0
    assert "5 photographs and their twins" in out
    assert (tmp_path / "shots-same.zarr").is_dir()
    code, out, _ = command(
        "compare", tmp_path / "shots.zarr", tmp_path / "shots-same.zarr", "--json")
    (median,) = (each for each in json.loads(out)["rows"]
                 if each["statistic"].startswith("rotation error, median")
                 and each["cornerRefinementMethod"] == "subpix")
    # The photographs were rendered with this scene, but for the board around each marker.
    assert 0.5 < median["gap"]["value"] < 2
    simulated = sweep.twins(tmp_path / "shots.zarr", scene)  # finished already
    assert simulated.sizes["trial"] == len(POSES)
    scene.write_text("[scene]\nblur_px = 3\n")
    code, _, err = command("compare", tmp_path / "shots.zarr", scene)
    assert code == 2
    assert "holds another experiment" in err
    assert "expected a store of photographs" in command(
        "compare", tmp_path / "shots-same.zarr", scene)[2]
