"""Documents: of nested dictionaries, with parameters that go together, and as users spell."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sweep
from support.documents import any_document
from support.lengths import lengths
from sweep.errors import PipelineError, StoreError
from sweep.experiment.document import document_text, read_document
from sweep.experiment.parameters import PARAMETERS, Stage
from sweep.experiment.photographs import read_board
from sweep.experiment.pipeline import (
    Pipeline,
    cell,
    parse_selection,
    parse_settings,
    selection_text,
)
from sweep.measure.detectors import REFINEMENTS
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import DetectionStatus
from sweep.messages import nearest
from sweep.model.renderers import warp_bitmap
from sweep.store.lifecycle import open_store

CHARACTERS = st.characters(categories=["L", "N", "P"], include_characters='"\\\' ')
MORE = {
    "axes": {"solver": ["ippe", "sqpnp"], "marker_id": {"range": [1, 9, 3]},
             "noise_grey": {"linspace": [0, 1, 4]}},
    "estimator": {"guarded": False},
}


@lengths(25, 400)
def test_text_of_a_pipeline_reads_back_to_an_equal_one(count):
    @settings(max_examples=count, deadline=None)
    @given(st.integers(0, 2**63 - 1), st.text(CHARACTERS, max_size=20), st.booleans())
    def check(seed, title, more):
        title = "".join(filter(str.isprintable, title))
        document = any_document(np.random.default_rng(seed)) | {"title": title, "seed": seed}
        if more:
            document = MORE | document | {"axes": document["axes"] | MORE["axes"]}
        pipeline = Pipeline.from_dict(document, name="a")
        assert Pipeline.from_text(pipeline.to_toml(), name="a") == pipeline

    check()


@lengths(25, 500)
def test_any_document_is_written_as_toml_that_means_the_same(count):
    values = st.recursive(
        st.one_of(st.booleans(), st.integers(), st.floats(allow_nan=False), st.dates(),
                  st.text(max_size=9)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner,
                                                                    max_size=3),
        max_leaves=8,
    )

    @settings(max_examples=count, deadline=None)
    @given(st.dictionaries(st.text(max_size=5), values, max_size=4))
    def check(document):
        try:
            text = document_text(document)
            text.encode()
        except UnicodeEncodeError:
            return  # a lone surrogate is no UTF-8
        assert read_document(text) == document

    check()


def test_values_of_python_and_numpy_stand_for_those_of_toml(tmp_path):
    pipeline = Pipeline.from_dict({
        "seed": np.int64(3),
        "camera": {"distortion": (0.1, 0.2, 0, 0), "width_px": np.int32(320)},
        "pose": {"roll_deg": np.float32(0.5)},
        "axes": {"distance_m": np.linspace(0.1, 1, 4), "marker_id": range(2, 10, 3)},
    })
    assert pipeline.seed == 3
    assert pipeline.fixed["distortion"] == (0.1, 0.2, 0.0, 0.0)
    assert pipeline.fixed["width_px"] == 320
    assert pipeline.axis("distance_m").values == tuple(np.linspace(0.1, 1, 4).tolist())
    assert pipeline.axis("marker_id").values == range(2, 10, 3)
    with pytest.raises(PipelineError, match="expected a level or an image file"):
        Pipeline.from_dict(
            {"pose": {"distance_m": 1}, "scene": {"background": Path("none.png")}},
            folder=tmp_path,
        )


def test_settings_replace_values_axes_and_distributions(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text("# kept\n[pose]\ndistance_m = 1\n[axes]\ntilt_deg = [0, 1]")
    pipeline = Pipeline.from_toml(
        path,
        ["tilt_deg=5", "distance_m=[1, 2]", "roll_deg={uniform = [0, 90]}", "solver=sqpnp",
         "trial=3", "distortion=[[], [0.1, 0, 0, 0]]", "seed=7"],
    )
    assert pipeline.fixed["tilt_deg"] == 5.0
    assert [axis.name for axis in pipeline.axes] == ["distance_m", "trial", "distortion"]
    assert pipeline.fixed["solver"] == "sqpnp"
    assert str(pipeline.distributions["roll_deg"]) == "uniform(0,90)"
    assert pipeline.seed == 7
    assert pipeline.text.startswith("# kept")
    again = Pipeline.from_text(pipeline.text)
    assert (again.fixed, again.axes) == (pipeline.fixed, pipeline.axes)


LOOP = {}
LOOP["pose"] = {"distance_m": LOOP}


@pytest.mark.parametrize(
    ("document", "message"),
    [({"pose": {"distance_m": None}}, "cell: pose.distance_m = None: expected a string, a number"),
     ({"pose": {"distance_m": 1}, "axes": {"tilt_deg": {1, 2}}},
      "axes.tilt_deg = {1, 2}: expected"),
     ({"pose": {3: 1}}, "cell: pose.3 = 1: expected a string"),
     ({"pose": {"distance_m": 1j}, "seed": None}, "seed = None: .*\n.*pose.distance_m = 1j: "),
     ({"pose": {"distance": 1}}, "pose.distance: unknown key; did you mean distance_m"),
     ({"axes": {"distance_m": np.arange(1.0, 40_000)}}, "expected at most 250,000 bytes"),
     (LOOP, "cell: pose.distance_m = .*: expected a string")],
)
def test_values_that_toml_does_not_have_are_told_by_key(document, message):
    with pytest.raises(PipelineError, match=message):
        Pipeline.from_dict(document, source="cell")


POSE = {"pose": {"distance_m": 0.5}}


def zipped_pipeline(axes, **sections):
    return sweep.Pipeline.from_dict(POSE | sections | {"axes": axes})


def test_members_come_in_every_form_of_an_axis():
    grid = zipped_pipeline({
        "lens": {"zip": {
            "fx_px": [600, 800, 1000], "fy_px": {"linspace": [600, 1000, 3]},
            "marker_id": {"range": [0, 3]}, "size_m": {"geom": [0.01, 1, 3]},
            "dictionary": {"values": ["DICT_4X4_50", "DICT_5X5_50", "DICT_4X4_50"]},
            "distortion": [[], [0.1, 0, 0, 0], [0, 0, 0, 0, 0]],
        }},
        "tilt_deg": [0, 30],
    })
    lens, _ = grid.axes
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
    assert [row["tilt_deg"] for row in grid.rows(["fx_px", "tilt_deg"])] == [0, 30] * 3


def test_draws_are_those_of_the_same_values_on_axes_of_their_own():
    drawn = {"pose": {"distance_m": 0.5, "tilt_deg": {"uniform": [0, 60]}, "jitter_px": 1}}
    one = zipped_pipeline({"lens": {"zip": {"fx_px": [600, 800], "fy_px": [600, 805]}}, "trial": 9},
                   **drawn)
    two = zipped_pipeline({"fx_px": [600, 800], "fy_px": [600, 805], "trial": 9}, **drawn)
    zipped = one.experiment.scene_values([np.array([0, 1, 1]), np.array([3, 4, 8])])
    apart = two.experiment.scene_values([np.array(k) for k in ([0, 1, 1], [0, 1, 1], [3, 4, 8])])
    for name in ("fx_px", "fy_px", "tilt_deg", "shift_u_px", "shift_v_px"):
        assert zipped[name].values.tolist() == apart[name].values.tolist()
    assert len(set(zipped["tilt_deg"].values.tolist())) == 3


def test_pairs_are_checked_and_not_their_product():
    zipped_pipeline({"tag": {"zip": {"dictionary": ["DICT_4X4_50", "DICT_4X4_100"],
                              "marker_id": [49, 99]}}})
    zipped_pipeline({"frame": {"zip": {"width_px": [100_000, 100], "height_px": [100, 100_000]}}})


def test_a_cell_is_named_by_values_a_label_or_a_number():
    grid = zipped_pipeline({"lens": {"zip": {"fx_px": [600, 800, 600], "fy_px": [600, 805, 700]}},
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


OPENCV = {
    "cornerRefinementMethod": {f"CORNER_REFINE_{name.upper()}": name for name in REFINEMENTS},
    "solver": {f"SOLVEPNP_{name.upper()}": name for name in SOLVERS
               if name not in ("photometric", "photometric_real", "recorded")},
    "dictionary": {name: name for name in dir(cv2.aruco) if name.startswith("DICT_")},
}


@pytest.mark.parametrize("name", OPENCV)
def test_every_name_of_opencv_is_understood_in_any_case_and_with_its_module(name):
    parameter = PARAMETERS[name]
    twins = {choice.casefold(): set() for choice in parameter.choices}
    for choice in parameter.choices:  # OpenCV has DICT_APRILTAG_16h5 and ..._16H5
        twins[choice.casefold()].add(choice)
    for spelled, choice in OPENCV[name].items():
        module = "cv2." if name == "solver" else "cv2.aruco."
        assert hasattr(cv2 if name == "solver" else cv2.aruco, spelled)
        for written in (spelled, spelled.lower(), spelled.title(), module + spelled, choice,
                        choice.upper(), f" {choice} ", f"cv::aruco::{spelled}",
                        choice.removeprefix("DICT_")):
            assert parameter.check(written) in twins[choice.casefold()], written
        assert parameter.check(spelled if name == "dictionary" else choice) == choice


@pytest.mark.parametrize(("written", "value"), [
    ("36h11", "DICT_APRILTAG_36h11"), ("tag36h11", "DICT_APRILTAG_36h11"),
    ("25h9", "DICT_APRILTAG_25h9"), ("Tag16H5", "DICT_APRILTAG_16h5"),
    ("AprilTag-36h10", "DICT_APRILTAG_36h10"), ("DICT_36h11", "DICT_APRILTAG_36h11"),
    ("mip_36h12", "DICT_ARUCO_MIP_36h12"), ("4x4-50", "DICT_4X4_50"), ("hd11", "STAG_HD11"),
    ("standard41h12", "tagStandard41h12"), ("circle21h7", "tagCircle21h7"),
])
def test_a_dictionary_is_understood_by_its_number_where_that_is_one(written, value):
    assert PARAMETERS["dictionary"].check(written) == value
    if value.startswith("DICT"):
        pipeline = Pipeline.from_text("[pose]\nside_px = 40", [f"dictionary={written}"])
        assert pipeline.fixed["dictionary"] == value


@pytest.mark.parametrize("written", ["", "?!", "l", "original", "36"])
def test_a_dictionary_is_not_understood_without_a_number_and_letters(written):
    with pytest.raises(ValueError, match="one of DICT_4X4_100"):
        PARAMETERS["dictionary"].check(written)


@given(st.sampled_from(sorted(PARAMETERS)), st.sampled_from(["camera", "pose", "estimator"]))
def test_a_parameter_in_a_wrong_section_is_told_with_the_right_one(name, section):
    assert f"did you mean {name}?" not in nearest(name, list(PARAMETERS))
    home = PARAMETERS[name].section
    if section != home:
        with pytest.raises(PipelineError, match=f"{name}: unknown key; it belongs under .{home}."):
            Pipeline.from_text(f"[{section}]\n{name} = 1")
        with pytest.raises(PipelineError, match=f"expected {name} or {home}.{name}"):
            Pipeline.from_text("", [f"{section}.{name}=1"])


@pytest.mark.parametrize(("wrong", "right"), [
    ("smok.toml", "smoke.toml"), ("Smoke.TOML", "smoke.toml"), ("smoke", "smoke.toml"),
    ("folder/smoek.toml", "folder/smoke.toml"),
])
def test_of_a_misspelled_file_the_nearest_in_its_folder_is_named(
    wrong, right, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name in ("smoke.toml", "other.toml", "camera.yaml", "board.toml", "folder/smoke.toml"):
        (tmp_path / name).touch()
    with pytest.raises(PipelineError, match=f"; did you mean {right}\\?"):
        Pipeline.from_toml(wrong)
    with pytest.raises(PipelineError, match=r"did you mean board\.toml"):
        read_board("bord.toml")
    with pytest.raises(PipelineError, match=r"did you mean camera\.yaml"):
        Pipeline.from_text('[camera]\ncamera_file = "camra.yaml"')
    (tmp_path / "runs/smoke.zarr").mkdir(parents=True)
    with pytest.raises(StoreError, match=r"did you mean runs/smoke\.zarr"):
        open_store("smok.zarr")


KEYS = {"none": {}, "grid": {"rows": 2, "columns": 2, "gap_m": 0.01},
        "charuco": {"squares_x": 3, "squares_y": 3, "square_m": 0.06}}


def of_board(*settings, size_m=0.05, **sections):
    marker = {"dictionary": "DICT_4X4_50"} | ({} if size_m is None else {"size_m": size_m})
    return Pipeline.from_dict({
        "marker": marker, "estimator": {"solver": "iterative"}, "pose": {"distance_m": 0.4},
        **sections,
    }, settings)


def test_warp_s_bitmap_of_a_board_has_a_limit():
    """OpenCV warps no more than 2^15 pixels a side."""
    def board(x_m):
        made = of_board("renderer=warp", board={"kind": "markers", "markers": [
            {"marker_id": k, "x_m": x, "y_m": 0} for k, x in ((1, 0), (2, x_m))]})
        return made.experiment.scene_values([])["board"].listed(1)[0]

    assert warp_bitmap(board(3), 0, 255).shape == (80, 3680)
    with pytest.raises(ValueError, match=r"a side of 32,766; this board takes 36,08. x 80$"):
        warp_bitmap(board(30), 0, 255)


@pytest.mark.parametrize("kind", KEYS)
def test_a_kind_that_is_chosen_drops_the_keys_of_others(kind):
    kinds = {"kind": ["none", "charuco", "grid"], "size_m": [0.1, 0.03, 0.05]}
    several = of_board(size_m=None, board=KEYS["grid"] | KEYS["charuco"],
                       axes={"target": {"zip": kinds}})
    single = of_board(f"kind={kind}", *(f"{name}={value}" for name, value in KEYS[kind].items()),
                      board={"kind": "grid", "rows": 5, "columns": 7, "gap_m": 0.01})
    for each in (cell(several, f"kind={kind},size_m=0.03"), single):
        own = {name for name in each.given if each.parameters[name].section == "board"}
        assert own == {"kind", *KEYS[kind]}


def test_cells_of_smaller_boards_fit_the_largest_of_another_grid():
    board = {"kind": "grid", "columns": 7, "gap_m": 0.01}
    variables = {each.name: each
                 for each in of_board("rows=[1,2]", board=board).experiment.variables}
    flags, errors = variables["marker_detection"], variables["marker_corner_error_px"]
    some = np.arange(1, 15, dtype=np.uint8).reshape(2, 7)
    assert (flags.fitted(some)[:, :7] == some).all()
    assert (flags.fitted(some)[:, 7:] == DetectionStatus.not_on_board).all()
    wide = np.zeros((3, 35, 4, 2), dtype=np.float32)
    assert errors.fitted(wide).shape == (3, 14, 4, 2)
    assert np.isnan(errors.fitted(wide[:, :7])[:, 7:]).all()
    assert errors.fitted(wide[:, :7]).dtype == np.float32
