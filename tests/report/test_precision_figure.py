"""The table of the poses that a wanted precision needed."""

import numpy as np
import xarray as xr

from sweep.analysis.decisions import Reached
from sweep.report.figures import precision_table


def test_each_configuration_has_the_number_of_conditions_by_flag():
    """What `precision_reached` gives of three conditions, two solvers and one quantity."""
    reached = np.array([[[1], [2], [3]], [[1], [1], [4]]], dtype=np.uint8)
    table = xr.Dataset(
        {"reached": (("solver", "side_px", "quantity"), reached),
         "half_width": (("solver", "side_px", "quantity"), reached * 0.01),
         "run": (("solver", "side_px"), np.array([[300, 50, 100]] * 2)),
         "wanted": ("quantity", [0.02])},
        {"solver": ["ippe", "sqpnp"], "side_px": [10, 20, 30], "quantity": ["detection_rate"]},
        {"configuration_dims": ["solver"]})
    shown = precision_table(table.set_coords("wanted"))
    rows = shown.rows
    assert "3 conditions, which took 50 to 300 poses each" in shown.caption
    assert [row[:2] for row in rows] == [
        ["detection_rate", "ippe"], ["detection_rate", "sqpnp"]]
    assert [row[4:] for row in rows] == [["0", "1", "1", "1", "0"], ["0", "2", "0", "0", "1"]]
    assert len(rows[0]) == 4 + len(Reached)
    assert [row[3] for row in rows] == ["0.0200", "0.0100"]  # the widest of those that are known

