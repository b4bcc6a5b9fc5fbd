"""A board's file gives the board, or every fault in a line of its own."""

import pytest

from sweep.errors import PipelineError
from sweep.experiment.photographs import read_board

CHARUCO = """kind = "charuco"
dictionary = "4x4_1000"
squares_x = 8
squares_y = 8
square_m = 0.0254
marker_m = 0.019
"""

GRID = """kind = "grid"
dictionary = "DICT_APRILTAG_36h10"
rows = 2
columns = 2
marker_m = 0.019
gap_m = 0.00475
corner_squares = true
"""

MARKERS = """kind = "markers"
dictionary = "DICT_5X5_50"
[[markers]]
marker_id = 1
x_m = 0
y_m = 0
size_m = 0.1
[[markers]]
marker_id = 2
x_m = 0.2
y_m = 0
size_m = 0.1
"""


def read(tmp_path, text):
    path = tmp_path / "board.toml"
    path.write_text(text)
    return read_board(path)


def faults(tmp_path, text):
    with pytest.raises(PipelineError) as raised:
        read(tmp_path, text)
    assert all("board.toml: " in fault for fault in raised.value.faults)
    return [fault.partition("board.toml: ")[2] for fault in raised.value.faults]


def test_each_kind_is_read(tmp_path):
    charuco = read(tmp_path, CHARUCO + "legacy_pattern = true\nfirst_id = 5")
    assert (charuco.dictionary, charuco.marker_ids) == ("DICT_4X4_1000", tuple(range(5, 37)))
    assert read(tmp_path, GRID + "ids = [3, 2, 1, 0]").marker_ids == (3, 2, 1, 0)
    assert read(tmp_path, MARKERS).marker_ids == (1, 2)


@pytest.mark.parametrize(("text", "line"), [
    ("", "kind: missing; expected one of charuco, grid, aprilgrid, markers"),
    ('kind = "charucco"', ('kind = "charucco": expected one of charuco, grid, aprilgrid, markers; '
     "did you mean charuco?")),
    ("kind = 3", "kind = 3: expected one of charuco, grid, aprilgrid, markers"),
    ("kind = ", "not TOML"),
    (CHARUCO + "square = 3", "square: unknown; expected a key of a board of kind charuco: "),
    (CHARUCO + "ids = [1, -2]", "ids = [1, -2]: expected a list of whole numbers from 0 on"),
    (CHARUCO + "ids = [1]", "ids = [1]: expected 32 IDs, one for each marker in reading order"),
    (CHARUCO + "ids = [1]\nfirst_id = 1", "first_id = 1: expected ids or first_id, not both"),
    (CHARUCO.replace("0.019", "nan"), "marker_m = nan: expected a number above 0"),
    (CHARUCO.replace("squares_x = 8", "squares_x = 1"), "squares_x = 1: expected a whole number"),
    (GRID.replace("0.00475", "0"), "gap_m = 0.0: expected above 0 beside corner_squares = true"),
    ('kind = "markers"\ndictionary = "DICT_5X5_50"\nmarkers = 3', "markers = 3: expected tables"),
    ('kind = "markers"\ndictionary = "DICT_5X5_50"\nmarkers = []', ("markers = []: expected 1 to "
     "4000 markers; these are 0")),
    (MARKERS.replace('50"', '50"\nmargin_m = 0.1\nquiet_zone_modules = 2'), ("margin_m = 0.1: "
     "expected margin_m (one sheet) or quiet_zone_modules (a sheet each), not both")),
])
def test_a_fault_is_one_line(tmp_path, text, line):
    found = faults(tmp_path, text)
    assert len(found) == 1
    assert found[0].startswith(line)


def test_a_file_that_cannot_be_read_is_one_line(tmp_path):
    for path, problem in ((tmp_path, "Is a directory"), (tmp_path / "none.toml", "No such file")):
        with pytest.raises(PipelineError, match=problem) as raised:
            read_board(path)
        assert len(raised.value.faults) == 1
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(PipelineError, match="expected UTF-8"):
        read_board(tmp_path / "x.toml")
