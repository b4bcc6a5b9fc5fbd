"""Published figures as pipelines: they can be read, and one of them comes out as its page says."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import sweep
from support.stores import by_hand
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import EstimateStatus

FOLDER = Path(__file__).parents[2] / "pipelines" / "published"
NEEDS = {
    "apriltag_334": ("pupil_apriltags", "pyapriltags"), "fmac": (),
    "render_tag": ("pupil_apriltags", "locus"), "roboception_range": ("pyapriltags",),
}


@pytest.mark.parametrize("name", NEEDS)
def test_the_pipelines_can_be_read(name):
    for module in NEEDS[name]:
        pytest.importorskip(module)
    assert Pipeline.from_toml(FOLDER / f"{name}.toml").size(*Stage) > 1


@pytest.mark.long
def test_the_errors_in_fmac_s_box_are_those_of_the_page(tmp_path):
    pipeline = Pipeline.from_toml(FOLDER / "fmac.toml", [
        "trial=3200", "dictionary=DICT_6X6_250", "cornerRefinementMethod=none"])
    by_hand(str(tmp_path / "fmac.zarr"), pipeline)
    results = sweep.open(tmp_path / "fmac.zarr")
    solved = (results.estimate == EstimateStatus.solved).values
    assert solved.mean() > 0.999
    errors = 1e3 * results.translation_error_m.values[solved].astype(float)
    # Ten standard deviations of a standard deviation of 3,200 heavy-tailed numbers are about 20 %.
    np.testing.assert_allclose(errors.std(axis=0), [4.6, 3.4, 12.8], rtol=0.2)
    assert 14 < errors[:, 2].mean() < 22


def test_the_page_has_the_register_s_table():
    make = runpy.run_path(str(FOLDER / "make.py"))
    assert make["table"]() in (FOLDER / "README.md").read_text()
    assert len(make["entries"]()) >= 10
    for entry in make["entries"]().values():
        assert {"source", "read", "given", "assumed", "prediction", "measured"} <= entry.keys()
        assert make["verdict"](entry) == "hit" or entry["measured"]["explanation"]
