"""Stores of runs with plug-ins: recorded, continued, reused, and read where the plug-in is not."""

from __future__ import annotations

import numpy as np
import pytest

import sweep
from support.stores import by_hand
from sweep.analysis.dataset import parameter_value
from sweep.cli import main
from sweep.errors import OtherExperimentError, PipelineError, StoreError
from sweep.evaluation.inspection import scene_image
from sweep.execution.reuse import match
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import open_store
from sweep.store.provenance import differences, fingerprint
from tests.plugins.test_detector_plugins import MINE

TEXT = """
[camera]
width_px = 160
height_px = 120
[marker]
size_m = 0.05
[pose]
side_px = 50
[detector]
shift_px = 0.25
[axes]
tilt_deg = [0, 40]
detector = ["opencv", "mine:TURNED"]
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a pipeline, its plug-in, and its store."""
    folder = tmp_path_factory.mktemp("plugged")
    (folder / "mine.py").write_text(MINE)
    (folder / "grid.toml").write_text(TEXT)
    execute(Pipeline.from_toml(folder / "grid.toml"), folder / "grid.zarr", workers=None)
    return folder


def test_the_dataset_has_the_detector_and_its_setting(made):
    results = sweep.open(made / "grid.zarr")
    assert results.detector.values.tolist() == ["opencv", "mine:TURNED"]
    assert float(results.shift_px) == 0.25
    assert results.shift_px.attrs["units"] == "px"
    shift = results.corner_error_px.diff("detector").values
    np.testing.assert_allclose(shift, 0.25, atol=1e-5)  # paired: the same images


def test_the_file_is_in_the_fingerprint_and_a_changed_one_is_not_continued(made):
    pipeline = Pipeline.from_toml(made / "grid.toml")
    assert open_store(str(made / "grid.zarr")).fingerprint == fingerprint(pipeline)
    assert list(pipeline.files) == ["mine.py"]
    assert execute(pipeline, made / "grid.zarr").computed_blocks == 0
    (made / "mine.py").write_text(MINE + "# another version\n")
    pipeline = Pipeline.from_toml(made / "grid.toml")
    try:
        with pytest.raises(OtherExperimentError, match=r"files: the store has \{'mine.py': "):
            execute(pipeline, made / "grid.zarr")
        with pytest.raises(StoreError, match="no cell of it can be reused"):
            execute(pipeline, made / "other.zarr", reuse=[made / "grid.zarr"])
    finally:
        (made / "mine.py").write_text(MINE)


def test_a_store_is_read_without_its_plug_in(made, tmp_path, capsys):
    (made / "mine.py").rename(tmp_path / "mine.py")
    try:
        results = sweep.open(made / "grid.zarr")
        assert (results.detection == 1).all()
        assert parameter_value(results.drop_vars("shift_px"), "shift_px") == 0.25
        assert main(["status", str(made / "grid.zarr")]) == 0
        capsys.readouterr()
        with pytest.raises(PipelineError, match=r"expected the file mine\.py in"):
            Pipeline.from_toml(made / "grid.toml")
    finally:
        (tmp_path / "mine.py").rename(made / "mine.py")


def test_verify_and_repro_recompute_with_the_plug_in(made, capsys):
    store = str(made / "grid.zarr")
    assert main(["verify", store, "--sample", "2"]) == 0
    assert "recomputed" in capsys.readouterr().out
    for detector in ("opencv", "mine:TURNED"):
        assert main(["repro", store, "--at", f"tilt_deg=40,detector={detector}"]) == 0
        assert "agrees with the store bit for bit" in capsys.readouterr().out


FOG = """
from dataclasses import dataclass
from sweep.plugins import EffectPlugin, parameter
@dataclass(frozen=True)
class Settings:
    {name}: float = parameter(0.0, "share of it in the light", low=0, high=1)
E = EffectPlugin(
    apply=lambda light, patch: light + patch.values["{name}"] * ({level} - light),
    settings=Settings,
)
"""


def test_effects_and_their_order_make_another_experiment(tmp_path):
    (tmp_path / "fog.py").write_text(FOG.format(name="fog", level=200))
    (tmp_path / "smoke.py").write_text(FOG.format(name="smoke", level=20))
    clear = "[pose]\nside_px = 50\ntilt_deg = 30\n[camera]\nwidth_px = 160\nheight_px = 120\n"
    foggy = clear + "[scene]\nfog = 0.3\nsmoke = 0.2\n"
    first = Pipeline.from_text('effects = ["fog:E", "smoke:E"]\n' + foggy, folder=tmp_path)
    second = Pipeline.from_text('effects = ["smoke:E", "fog:E"]\n' + foggy, folder=tmp_path)
    without = Pipeline.from_text(clear, folder=tmp_path)
    images = [scene_image(pipeline) for pipeline in (first, second, without)]
    assert (images[0] != images[1]).any()
    store = by_hand(str(tmp_path / "first.zarr"), first)
    for other in (second, without):
        assert any(line.startswith("effects: ")
                   for line in differences(other, store.pipeline, store.fingerprint))
        with pytest.raises(StoreError, match="no cell of it can be reused"):
            match(other, store)
    assert not differences(first, store.pipeline, store.fingerprint)
