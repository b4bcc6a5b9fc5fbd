"""``sweep compare``: its table, its JSON, and its figure."""

import json

import numpy as np
import pytest

import sweep
from support.board_photographs import POSES, write_set
from support.photograph_results import results_of, twins
from support.reports import command
from sweep.analysis import simulation_gap
from sweep.report.findings import gap_lines, gap_table


def test_the_table_has_a_row_for_each_statistic_configuration_and_bin():
    rng = np.random.default_rng(1)
    first, second = results_of(rng), twins(rng)
    gap = simulation_gap(first, second, bins={"side_px": [1, 20, 40, 70]})  # none in the first
    table = gap_table(gap)
    assert list(table.headings) == [
        "statistic", "cornerRefinementMethod", "side_px", "photographs", "simulated",
        "compared by", "gap"]
    assert len(table.rows) == 7 * 2 * 3
    row = next(row for row in table.rows
               if row[:3] == ["range bias median, %", "subpix", "20\u201340"])
    at = gap.sel(cornerRefinementMethod="subpix").isel(side_px=1)
    assert float(row[3].replace("\u2212", "-")) == pytest.approx(
        at.range_bias_median_percent.values[0], rel=0.01)
    assert "to" in row[6]
    assert gap_lines(gap) == ["12 photographs and their twins, pairs of markers"]
    few = simulation_gap(results_of(rng, 3), second)
    assert gap_lines(few)[-1] == "fewer than 5 photographs: errors without intervals"


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
    figure = tmp_path / "gap.svg"
    code, out, _ = command("compare", tmp_path / "shots.zarr", scene, "-o", figure)
    assert code == 0
    assert "<svg" in figure.read_text()
    assert "5 photographs and their twins" in out
    assert (tmp_path / "shots-same.zarr").is_dir()
    stores = tmp_path / "shots.zarr", tmp_path / "shots-same.zarr"
    code, out, _ = command("compare", *stores, "--json")
    (median,) = (each for each in json.loads(out)["rows"]
                 if each["statistic"].startswith("rotation median")
                 and each["cornerRefinementMethod"] == "subpix")
    # The photographs were rendered with this scene, but for the board around each marker.
    assert 0.5 < median["gap"]["value"] < 2
    assert json.loads(sweep.compare(*stores, reuse=[]).to_json())["rows"] == json.loads(out)["rows"]
    simulated = sweep.twins(tmp_path / "shots.zarr", scene)  # finished already
    assert simulated.sizes["trial"] == len(POSES)
    scene.write_text("[scene]\nblur_px = 3\n")
    code, _, err = command("compare", tmp_path / "shots.zarr", scene)
    assert code == 2
    assert "holds another experiment" in err
    assert "expected a store of photographs" in command(
        "compare", tmp_path / "shots-same.zarr", scene)[2]
