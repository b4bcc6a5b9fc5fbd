"""Plug-ins of a file, of a package and of the guide: searched, recorded, and read without them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import sweep
from support.blocks import run_cells
from support.stores import by_hand
from sweep.analysis.dataset import parameter_value
from sweep.cli import main
from sweep.errors import OtherExperimentError, PipelineError, PluginError, StoreError
from sweep.evaluation.inspection import scene_image
from sweep.execution.reuse import match
from sweep.execution.runner import execute
from sweep.experiment.parameters import lacking_plugins
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins import loading
from sweep.store.lifecycle import open_store
from sweep.store.provenance import differences, fingerprint

MINE = '''
from dataclasses import dataclass
import cv2
import numpy as np
from sweep.plugins import DetectorPlugin, parameter

@dataclass(frozen=True)
class Settings:
    shift_px: float = parameter(0.0, "shift of the corners", unit="px", low=-9, high=9)

class Turned:
    """OpenCV's own search, with other conventions."""

    def __init__(self, settings, family):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
        self.search = cv2.aruco.ArucoDetector(dictionary).detectMarkers
        self.shift = settings.shift_px

    def __call__(self, image):
        corners, ids, _ = self.search(image)
        if ids is None:
            return [], []
        turned = np.concatenate(corners)[:, [2, 3, 0, 1]]
        return turned + 0.5 + self.shift, ids.ravel()

TURNED = DetectorPlugin(
    make=Turned, settings=Settings, pixel_center=0.5, corner_order=(2, 3, 0, 1), margin_px=16,
)
'''

GRID = """
[marker]
size_m = 0.05
[pose]
distance_m = 0.4
[axes]
tilt_deg = [0, 40]
detector = ["opencv", "mine:TURNED"]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    return tmp_path


def test_a_detector_of_other_conventions_gives_opencv_s_corners(folder):
    text = GRID + "shift_px = [0, 0.25]\n"
    pipeline = Pipeline.from_text(text, folder=folder)
    assert pipeline.files.keys() == {"mine.py"}
    columns = run_cells(pipeline, [np.arange(2)]).columns
    # detector x shift_px: a setting that OpenCV does not have changes nothing there.
    opencv, same, plain, shifted = columns["corner_error_px"]
    np.testing.assert_array_equal(opencv, same)
    np.testing.assert_allclose(plain, opencv, rtol=0, atol=1e-5)  # OpenCV's corners are float32
    np.testing.assert_allclose(shifted, opencv + 0.25, rtol=0, atol=1e-5)
    assert (np.array(columns["detection"]) == DetectionStatus.detected).all()


@pytest.mark.parametrize(("setting", "told"), [
    ("shift_px = [0, 10]", "axes.shift_px = [0, 10]: expected a number from -9 to 9 (not 10)"),
    ("shift_pixels = [0, 10]", "unknown key; did you mean shift_px?"),
])
def test_settings_are_checked_as_our_own(setting, told, folder):
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(f"{GRID}{setting}\n", folder=folder)
    assert told in str(refused.value)


def test_two_plug_ins_share_a_setting_only_if_it_is_declared_equally(folder):
    (folder / "other.py").write_text(MINE)
    both = GRID.replace('"mine:TURNED"]', '"mine:TURNED", "other:TURNED"]\nshift_px = [0, 1]')
    assert len(Pipeline.from_text(both, folder=folder).experiment.detectors) == 6
    (folder / "other.py").write_text(MINE.replace("high=9", "high=8"))
    with pytest.raises(PipelineError, match="expected its setting shift_px to be declared as"):
        Pipeline.from_text(both, folder=folder)


# Plug-ins of installed packages.

ENTRY_POINTS = """[sweep.detectors]
turned = fast_markers.detectors:TURNED
broken = fast_markers.nowhere:TURNED
[sweep.effects]
turned = fast_markers.detectors:TURNED
"""


def install(folder, name, version, entry_points=ENTRY_POINTS):
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(entry_points)
    return info


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder of packages, with one that offers plug-ins."""
    package = tmp_path / "fast_markers"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "detectors.py").write_text(MINE)
    install(tmp_path, "fast-markers", "1.2.3")
    monkeypatch.syspath_prepend(tmp_path)
    loading._of_entry_point.cache_clear()
    yield tmp_path
    loading._of_entry_point.cache_clear()
    for name in [name for name in sys.modules if name.startswith("fast_markers")]:
        del sys.modules[name]


INSTALLED = '[pose]\nside_px = 50\n[axes]\ndetector = ["opencv", "turned"]\nshift_px = [0, 1]\n'


def test_an_installed_detector_is_named_and_its_version_recorded(site):
    pipeline = Pipeline.from_text(INSTALLED)
    corners = run_cells(pipeline, []).columns["corner_error_px"]
    np.testing.assert_allclose(corners[3], corners[0] + 1, atol=1e-5)
    assert fingerprint(pipeline)["plugins"] == {"turned": {"fast-markers": "1.2.3"}}
    assert not pipeline.files
    assert not lacking_plugins(pipeline.plugins, ".")
    (site / "fast_markers-1.2.3.dist-info").rename(site / "fast_markers-1.3.dist-info")
    metadata = site / "fast_markers-1.3.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.2.3", "1.3"))
    assert lacking_plugins(pipeline.plugins, ".") == [
        "detector turned: expected fast-markers 1.2.3, not fast-markers 1.3"
    ]
    (plugin,) = pipeline.plugins
    with pytest.raises(PluginError):
        plugin.record(".")


@pytest.mark.usefixtures("site")
def test_names_are_listed_without_an_import(capsys):
    assert main(["plugins"]) == 0
    out = capsys.readouterr().out
    assert "detector   turned               of fast-markers" in out
    assert "detector   broken               of fast-markers" in out
    assert not any(name.startswith("fast_markers") for name in sys.modules)
    assert main(["plugins", "broken"]) == 2
    assert "ModuleNotFoundError: No module named 'fast_markers.nowhere'" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "told"), [
    ("broken", "a plug-in that can be imported: ModuleNotFoundError"),
    ("turnd", "did you mean turn"), ("turned", "fast-markers and slow-markers both have it"),
])
def test_an_installed_plug_in_that_cannot_be_used_is_one_line(name, told, site):
    install(site, "slow-markers", "1.0", "[sweep.detectors]\nturned = slow:D\n")
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(INSTALLED.replace("turned", name))
    (line,) = refused.value.faults
    assert line.startswith(f'pipeline: axes.detector = "{name}": expected ')
    assert told in line


# Stores of runs with plug-ins.

STORED = """
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
    (folder / "grid.toml").write_text(STORED)
    execute(Pipeline.from_toml(folder / "grid.toml"), folder / "grid.zarr", workers=None)
    return folder


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
        assert results.detector.values.tolist() == ["opencv", "mine:TURNED"]
        assert (float(results.shift_px), results.shift_px.attrs["units"]) == (0.25, "px")
        shift = results.corner_error_px.diff("detector").values
        np.testing.assert_allclose(shift, 0.25, atol=1e-5)  # paired: the same images
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
    assert main(["repro", store, "--at", "tilt_deg=40,detector=mine:TURNED"]) == 0
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


FOLDER = Path(__file__).parents[2] / "pipelines" / "plugins"

SCENE = {
    "camera": {"width_px": 160, "height_px": 120, "fx_px": 200, "fy_px": 200},
    "marker": {"size_m": 0.05, "marker_id": 3},
    "pose": {"distance_m": 0.2, "tilt_deg": 35, "azimuth_deg": 20, "roll_deg": 12},
}


def test_the_pipeline_runs_with_all_four():
    pipeline = Pipeline.from_toml(FOLDER / "plugins.toml", ["trial=2", "side_px=60"])
    assert {plugin.kind for plugin in pipeline.plugins} == {
        "detector", "estimator", "effect", "renderer",
    }
    cells = run_cells(pipeline, [index.ravel() for index in np.indices((2, 2, 2))])
    assert not cells.failures
    assert (np.array(cells.columns["detection"]) == DetectionStatus.detected).all()
    assert (np.array(cells.columns["estimate"]) == EstimateStatus.solved).all()


def test_the_renderer_samples_each_pixel_at_its_centre():
    images = [
        scene_image(Pipeline.from_dict(
            SCENE | {"scene": {"renderer": name, "background": 90}}, folder=FOLDER,
        ), whole_frame=True) for name in ("sampled:RENDERER", "supersample-1")
    ]
    np.testing.assert_array_equal(*images)
    assert len(np.unique(images[0])) == 3
