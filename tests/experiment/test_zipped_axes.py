"""Axes along which parameters go together."""

import numpy as np
import pytest

import sweep
from sweep.errors import PipelineError
from sweep.experiment.grid import combinations
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import cell, parse_selection, parse_settings, selection_text

POSE = {"pose": {"distance_m": 0.5}}


def pipeline(axes, **sections):
    return sweep.Pipeline.from_dict(POSE | sections | {"axes": axes})


def refused(axes, **sections):
    with pytest.raises(PipelineError) as refusal:
        pipeline(axes, **sections)
    return str(refusal.value).removeprefix("pipeline: ")


def test_members_come_in_every_form_of_an_axis():
    grid = pipeline({
        "lens": {"zip": {
            "fx_px": [600, 800, 1000], "fy_px": {"linspace": [600, 1000, 3]},
            "marker_id": {"range": [0, 3]}, "size_m": {"geom": [0.01, 1, 3]},
            "dictionary": {"values": ["DICT_4X4_50", "DICT_5X5_50", "DICT_4X4_50"]},
            "distortion": [[], [0.1, 0, 0, 0], [0, 0, 0, 0, 0]],
        }},
        "tilt_deg": [0, 30],
    })
    (lens, tilt) = grid.axes
    assert (lens.name, len(lens), lens.stage, lens.unit) == ("lens", 3, Stage.scene, "")
    assert lens.values[1] == "800, 800, 1, 0.1, DICT_5X5_50, [0.1, 0.0, 0.0, 0.0]"
    assert lens.at(1) == {
        "fx_px": 800.0, "fy_px": 800.0, "marker_id": 1, "size_m": pytest.approx(0.1),
        "dictionary": "DICT_5X5_50", "distortion": (0.1, 0.0, 0.0, 0.0),
    }
    assert list(grid.values_of("fx_px")) == [600, 800, 1000]
    assert grid.any_value("marker_id", lambda value: value == 2)
    assert grid.axis("fx_px") is None
    assert grid.axis_of("fx_px") is lens
    assert grid.size(Stage.scene) == 6
    assert sweep.Pipeline.from_text(grid.to_toml()) == grid
    assert [row["tilt_deg"] for row in combinations([lens, tilt])] == [0, 30] * 3


def test_draws_are_those_of_the_same_values_on_axes_of_their_own():
    drawn = {"pose": {"distance_m": 0.5, "tilt_deg": {"uniform": [0, 60]}, "jitter_px": 1}}
    one = pipeline({"lens": {"zip": {"fx_px": [600, 800], "fy_px": [600, 805]}}, "trial": 9},
                   **drawn)
    two = pipeline({"fx_px": [600, 800], "fy_px": [600, 805], "trial": 9}, **drawn)
    zipped = one.experiment.scene_values([np.array([0, 1, 1]), np.array([3, 4, 8])])
    apart = two.experiment.scene_values([np.array(k) for k in ([0, 1, 1], [0, 1, 1], [3, 4, 8])])
    for name in ("fx_px", "fy_px", "tilt_deg", "shift_u_px", "shift_v_px"):
        assert zipped[name].values.tolist() == apart[name].values.tolist()
    assert len(set(zipped["tilt_deg"].values.tolist())) == 3


def test_pairs_are_checked_and_not_their_product():
    pipeline({"tag": {"zip": {"dictionary": ["DICT_4X4_50", "DICT_4X4_100"],
                              "marker_id": [49, 99]}}})
    pipeline({"frame": {"zip": {"width_px": [100_000, 100], "height_px": [100, 100_000]}}})


def test_a_million_rows_are_read_and_a_row_more_is_not():
    def many(count):
        return {"zip": {name: {"linspace": [1, 9, count]} for name in ("fx_px", "fy_px")}}

    assert len(pipeline({"lens": many(100_000)}).axes[0]) == 100_000
    assert "at most 1,000,000 values, all axes together" in refused({"lens": many(500_001)})


def test_a_cell_is_named_by_values_a_label_or_a_number():
    grid = pipeline({"lens": {"zip": {"fx_px": [600, 800, 600], "fy_px": [600, 805, 700]}},
                     "tilt_deg": [0, 30], "trial": 1})
    for at, fx, fy in (
        ("", 600, 600), ("fx_px=800", 800, 805), ("fy_px=700", 600, 700), ("lens=2", 600, 700),
        ('lens="800, 805",tilt_deg=30', 800, 805), ("fx_px=600,fy_px=700", 600, 700),
        ("fx_px=123", 123, 600),
    ):
        fixed = cell(grid, at).fixed
        assert (fixed["fx_px"], fixed["fy_px"]) == (fx, fy), at
        assert [axis.name for axis in cell(grid, at).axes] == ["trial"]
    index = {"lens": 1, "tilt_deg": 0, "trial": 0}
    text = selection_text(grid, index)
    assert text == "fx_px=800.0,fy_px=805.0,tilt_deg=0.0,trial=0"
    assert cell(grid, text).fixed["fy_px"] == 805
    for at, line in (
        ("lens=3", 'expected a number from 0 to 2, or a label such as "600, 600"'),
        ("lens=600", "expected a number from 0 to 2"),
        ("fx_px=600,lens=1", "fx_px is given twice"),
        ("lense=1", "unknown parameter; did you mean lens?"),
    ):
        with pytest.raises(PipelineError, match=line):
            parse_selection(at, grid)


def test_settings_make_and_replace_such_axes():
    text = "[pose]\ndistance_m = 0.5\n[axes]\ntilt_deg = [0, 1] # kept\n"
    made = sweep.Pipeline.from_text(text, ["lens={zip={fx_px=[600, 800], fy_px=[600, 805]}}"])
    assert made.axis_of("fy_px").values == ("600, 600", "800, 805")
    assert "# kept" in made.text
    again = sweep.Pipeline.from_text(made.text, ["axes.lens={zip={fx_px=[6, 8], fy_px=[6, 8]}}"])
    assert list(again.values_of("fx_px")) == [6, 8]
    with pytest.raises(PipelineError, match=r"axes.lens.fx_px is given too|camera.fx_px is given"):
        sweep.Pipeline.from_text(made.text, ["fx_px=500"])
    with pytest.raises(PipelineError, match="unknown parameter"):
        parse_settings(["lens=[1, 2]"])
