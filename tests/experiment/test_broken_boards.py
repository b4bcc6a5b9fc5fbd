"""A board that cannot be says so, in one line."""

import numpy as np
import pytest

from sweep.errors import PipelineError
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus

TEXT = """
[marker]
dictionary = "DICT_4X4_50"
size_m = 0.05
[estimator]
solver = "iterative"
[pose]
distance_m = 0.4
[board]
"""
ONE = "[[board.markers]]\nmarker_id = 1\nx_m = 0\ny_m = 0\n"
OTHER = "[[board.markers]]\nmarker_id = 2\nx_m = 0.1\ny_m = 0\n"
GRID = 'kind = "grid"\nrows = 5\ncolumns = 7\ngap_m = 0.01'


def beside(**keys):
    return "\n[[board.distractors]]\n" + "".join(f"{k} = {v}\n" for k, v in keys.items())


TABLE = f'kind = "markers"\n{ONE}{OTHER}'

BROKEN = {
    "markers that overlap": (
        TABLE.replace("0.1", "0.06"), "board.markers = [1, 2]: expected markers that do not overlap"
    ),
    "an ID twice": (
        TABLE.replace("= 2", "= 1"), "board.markers = [1, 1]: expected each ID once; 1 is listed"
    ),
    "an ID beyond the dictionary": (TABLE.replace("= 2", "= 50"), "expected IDs from 0 to 49"),
    "an unknown key of a marker": (
        TABLE.replace("y_m = 0\n", "y_m = 0\nw_m = 0\n", 1),
        "board.markers[0].w_m: unknown; expected a key of a marker: marker_id, x_m",
    ),
    "a missing key of a marker": (
        TABLE.replace("x_m = 0.1\n", ""), "board.markers[1].x_m: missing; expected a number"
    ),
    "a coordinate that is no number": (
        TABLE.replace("0.1", "nan"), "board.markers[1].x_m = nan: expected a number from"
    ),
    "no table of markers": (
        'kind = "markers"\nmarkers = [3]', "board.markers = [3]: expected tables with marker_id"
    ),
    "a dictionary too small": (
        'kind = "charuco"\nsquares_x = 20\nsquares_y = 20\nsquare_m = 0.06',
        "expected IDs from 0 to 49, which is what DICT_4X4_50 has; the board has 200 markers",
    ),
    "markers larger than their squares": (
        'kind = "diamond"\nsquare_m = 0.05', "marker.size_m = 0.05: expected below square_m"
    ),
    "too many markers": (GRID.replace("7", "1000"), "a board of at most 4000 markers; it has 5000"),
    "a kind without its sizes": ('kind = "diamond"', 'board.square_m: missing; kind = "diamond"'),
    "sizes without a kind": (
        "rows = 3", "board.rows = 3: expected kind = grid, which uses it; kind = none does not"
    ),
    "a distractor on the board": (
        GRID + beside(x_m=0.2, y_m=0.16),
        "board.distractors[0].x_m = 0.2: expected no overlap with the board, white quiet zones",
    ),
    "distractors on one another": (
        GRID + beside(x_m=0.5, y_m=0) + beside(x_m=0.55, y_m=0.01, roll_deg=45),
        "board.distractors[1].x_m = 0.55: expected no overlap with distractors[0]",
    ),
    "a distractor on a tilted one": (
        GRID + beside(x_m=0.5, y_m=0, tilt_deg=90, azimuth_deg=0)
        + beside(x_m=0.5, y_m=0, z_m=0.03, tilt_deg=90, azimuth_deg=0),
        "board.distractors[1].x_m = 0.5: expected no overlap with distractors[0]",
    ),
    "an unknown ID of a distractor": (
        GRID + beside(x_m=0.5, y_m=0, marker_id=50),
        "board.distractors[0].marker_id = 50: expected an ID from 0 to 49, which is what DICT_4X4",
    ),
    "a size of another kind": (
        GRID + "\nsquare_m = 0.06",
        "board.square_m = 0.06: expected kind = charuco or diamond, which uses it; kind = grid ",
    ),
    "a list of markers beside a grid": (
        f"{GRID}\n{ONE}", "expected kind = markers, which uses it; kind = grid does not"
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_board_that_cannot_be_is_one_line(name):
    text, expected = BROKEN[name]
    with pytest.raises(PipelineError) as error:
        Pipeline.from_text(TEXT + text, [])
    (line,) = str(error.value).splitlines()
    assert expected in line
    assert len(line) < 400


def test_all_faults_of_a_table_come_at_once():
    with pytest.raises(PipelineError) as error:
        Pipeline.from_text(TEXT + TABLE.replace("x_m = 0\n", "X = 0\n") + "size_m = true", [])
    assert [line.split(" ")[1] for line in error.value.faults] == [
        "board.markers[0].X:", "board.markers[0].x_m:", "board.markers[1].size_m"
    ]


@pytest.mark.parametrize(("x_m", "size"), [(30, "36,08. x 80"), (3, None)])
def test_warp_s_bitmap_of_a_board_has_a_limit(x_m, size):
    """OpenCV warps no more than 2^15 pixels a side."""
    text = TEXT + TABLE.replace("0.1", str(x_m))
    if size is None:
        Pipeline.from_text(text, ["renderer=warp"])
    else:
        with pytest.raises(PipelineError, match=f'"warp": expected another renderer.* {size}$'):
            Pipeline.from_text(text, ["renderer=warp"])


@pytest.mark.parametrize(("setting", "expected"), [
    ("solver='ippe_square'", "others with points = largest_marker"),
    ("points='chessboard'", "kind = charuco or diamond, which have a chessboard"),
])
def test_a_solver_that_boards_lack_is_one_line(setting, expected):
    with pytest.raises(PipelineError) as error:
        Pipeline.from_text(TEXT + GRID, [setting])
    (line,) = str(error.value).splitlines()
    assert expected in line


DISTRACTOR = beside(x_m=0.5, y_m=0)
SOLID = beside(x_m=0.5, y_m=0, z_m=0.1)


@pytest.mark.parametrize(("board", "setting", "expected"), [
    (GRID + SOLID, "renderer='warp'", "exact, for distractors with z_m or tilt_deg"),
    (GRID + SOLID, "curvature_per_m=1",
     "it absent, for distractors with z_m or tilt_deg"),
    (DISTRACTOR, "solver='ippe_square'", "for boards; others with points = largest_marker"),
])
def test_what_distractors_cannot_have_is_one_line(board, setting, expected):
    with pytest.raises(PipelineError) as error:
        Pipeline.from_text(TEXT + board, [setting])
    (line,) = str(error.value).splitlines()
    assert expected in line


def test_distractors_may_touch_share_an_id_and_stand_in_planes_of_their_own():
    sheet = 0.05 * 8 / 6
    apart = beside(x_m=0.5, y_m=0) + beside(x_m=0.5 + sheet, y_m=0) + "marker_id = 3"
    above = beside(x_m=0, y_m=0, z_m=0.1) + beside(x_m=0.5, y_m=0, tilt_deg=20)
    for board in (GRID + apart, apart, GRID + above, TABLE + above):
        assert Pipeline.from_text(TEXT + board, []) is not None


def test_without_a_solver_the_message_names_those_of_boards():
    with pytest.raises(PipelineError) as error:
        Pipeline.from_text(TEXT.replace('solver = "iterative"', "") + GRID, [])
    (line,) = str(error.value).splitlines()
    assert "estimator.solver: missing; a board needs one of ippe, iterative, sqpnp, epnp" in line


AXIS = """[axes]
target = { zip = { kind = ["none", "charuco", "grid"], size_m = [0.1, 0.03, 0.05] } }
"""
OF_KINDS = """rows = 2
columns = 2
gap_m = 0.01
squares_x = 3
squares_y = 3
square_m = 0.06
"""
OF_BOARDS = TEXT.replace("size_m = 0.05\n", "") + OF_KINDS


def test_each_of_several_kinds_uses_its_own_keys():
    pipeline = Pipeline.from_text(OF_BOARDS + AXIS, [])
    boards = pipeline.experiment.scene_values([np.arange(3)])["board"].listed(3)
    assert [len(board) for board in boards] == [1, 4, 4]


@pytest.mark.parametrize(("kind", "kept"), [
    ("charuco", {"squares_x", "squares_y", "square_m"}), ("grid", {"rows", "columns", "gap_m"}),
    ("none", set()),
])
def test_a_kind_that_is_chosen_drops_the_keys_of_others(kind, kept):
    axis = Pipeline.from_text(OF_BOARDS + AXIS, [])
    fixed = axis.fixed_at({"kind": kind, "size_m": 0.03})
    assert {name for name in fixed.given if axis.parameters[name].section == "board"} == {
        "kind", *kept
    }
    single = Pipeline.from_text(TEXT + GRID, [f"kind={kind}", *(
        f"{name}={value}" for name, value in (line.split(" = ") for line in OF_KINDS.splitlines())
        if name in kept
    )])
    assert {name for name in single.given if axis.parameters[name].section == "board"} == {
        "kind", *kept
    }


def test_rows_of_a_grid_can_be_an_axis():
    pipeline = Pipeline.from_text(TEXT + GRID, ["rows=[1,2,5]"])
    boards = pipeline.experiment.scene_values([np.arange(3)])["board"].listed(3)
    assert [len(board) for board in boards] == [7, 14, 35]


def test_cells_of_smaller_boards_fit_the_largest_of_another_grid():
    flags, errors = (
        next(each for each in Pipeline.from_text(TEXT + GRID, ["rows=[1,2]"]).experiment.variables
             if each.name == name)
        for name in ("marker_detection", "marker_corner_error_px")
    )
    some = np.arange(1, 15, dtype=np.uint8).reshape(2, 7)
    assert (flags.fitted(some)[:, :7] == some).all()
    assert (flags.fitted(some)[:, 7:] == DetectionStatus.not_on_board).all()
    wide = np.zeros((3, 35, 4, 2), dtype=np.float32)
    assert errors.fitted(wide).shape == (3, 14, 4, 2)
    assert np.isnan(errors.fitted(wide[:, :7])[:, 7:]).all()
    assert errors.fitted(wide[:, :7]).dtype == np.float32
