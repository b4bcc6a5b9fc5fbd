"""Adding a statistic touches one place: a record in the registry, which these tests really add.

The references are plain NumPy on all poses at once.
"""

import numpy as np
import pytest

from support.small_datasets import mixed
from sweep.analysis import error_statistics, estimator
from sweep.analysis import summaries as registry
from sweep.analysis.estimator import PositiveMean
from sweep.analysis.summaries import ErrorStatistic
from sweep.errors import DatasetError
from sweep.measure.flags import EstimateStatus
from sweep.report.figures import errors_table
from sweep.report.reference import TABLES

SIZES = {"marker_id": 2, "tilt_deg": 2, "noise_grey": 2, "trial": 30, "solver": 2}
RESULTS = mixed(SIZES, 7)

# A mean with its interval, of a class that exists: three lines.
MEAN_ABSOLUTE_ERROR = ErrorStatistic(
    {"mae": "mean absolute error of the solved"},
    lambda quantity: PositiveMean(
        quantity.named("mae"), f"mean absolute {quantity.words}, solved", quantity.units,
        lambda poses: quantity.norm(poses)[..., None], lambda poses: poses.solved))


@pytest.fixture(autouse=True)
def _added(monkeypatch):
    monkeypatch.setattr(
        registry, "ERROR_STATISTICS", (*registry.ERROR_STATISTICS, MEAN_ABSOLUTE_ERROR))


def test_an_added_statistic_is_that_of_plain_numpy_with_attributes_and_a_row_in_every_table():
    table = error_statistics(RESULTS)
    vectors = RESULTS["rotation_error_rad"].values.astype(float)
    solved = RESULTS["estimate"].values == EstimateStatus.solved
    mean = np.degrees(np.linalg.norm(vectors, axis=-1)[solved]).mean()
    assert table["rotation_mae_deg"] == pytest.approx(mean, rel=1e-12)
    assert table["rotation_mae_deg_low"] < mean < table["rotation_mae_deg_high"]
    for name, unit in (("rotation_mae_deg", "degree"), ("range_mae_percent_low", "percent")):
        assert table[name].attrs["units"] == unit
        assert "mean absolute" in table[name].attrs["description"]
    assert ["*_mae_*", "error: mean absolute error of the solved"] in TABLES["statistics"]().rows
    assert "mean absolute error of the solved" in [row[0] for row in errors_table(table, "").rows]


def test_a_column_that_cannot_be_sorted_at_once_is_told_how_to_divide(monkeypatch):
    monkeypatch.setattr(estimator, "MAX_VALUES", 100)
    with pytest.raises(DatasetError, match="expected at most 100; divide them: keep an axis apart"):
        error_statistics(RESULTS)
