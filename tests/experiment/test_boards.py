"""Boards of several kinds in one pipeline, and the most that a board can be."""

import numpy as np
import pytest

from sweep.experiment.pipeline import Pipeline, cell
from sweep.measure.flags import DetectionStatus
from sweep.model.renderers import bitmap_shape

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
GRID = 'kind = "grid"\nrows = 5\ncolumns = 7\ngap_m = 0.01'


TABLE = 'kind = "markers"\n' + "".join(
    f"[[board.markers]]\nmarker_id = {k}\nx_m = {x}\ny_m = 0\n" for k, x in ((1, 0), (2, 0.1)))


def test_warp_s_bitmap_of_a_board_has_a_limit():
    """OpenCV warps no more than 2^15 pixels a side."""
    def board(x_m):
        made = Pipeline.from_text(TEXT + TABLE.replace("0.1", x_m), ["renderer=warp"])
        return made.experiment.scene_values([])["board"].listed(1)[0]

    assert bitmap_shape(board("3")) == (80, 3680)
    with pytest.raises(ValueError, match=r"a side of 32,766; this board takes 36,08. x 80$"):
        bitmap_shape(board("30"))


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
    fixed = cell(axis, f"kind={kind},size_m=0.03")
    single = Pipeline.from_text(TEXT + GRID, [f"kind={kind}", *(
        line for line in OF_KINDS.splitlines() if line.partition(" ")[0] in kept)])
    for each in (fixed, single):
        own = {name for name in each.given if axis.parameters[name].section == "board"}
        assert own == {"kind", *kept}


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
