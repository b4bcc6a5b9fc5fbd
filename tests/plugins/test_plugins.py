"""Plug-ins of a file, of a package and of the guide: searched, recorded, and read without them.

Those at fault are told in a line each, and what others computed is not lost.
"""

from __future__ import annotations

import signal
import sys
import time
from unittest import mock

import numpy as np
import pytest

import sweep
from support.blocks import run_cells
from support.here import Here
from support.stores import by_hand
from sweep.analysis.dataset import parameter_value
from sweep.cli import main
from sweep.errors import PipelineError, PluginError, StoreError
from sweep.evaluation.block import try_plugins
from sweep.evaluation.inspection import scene_image
from sweep.execution.block_task import match, other_here
from sweep.execution.runner import check_plugins, execute
from sweep.experiment.parameters import lacking_plugins
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import full_frame_reason
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins.loading import call
from sweep.store.lifecycle import open_store
from sweep.store.provenance import differences, fingerprint
from sweep.tradeoff.costs import clock_of

MINE = """
from dataclasses import dataclass
import cv2
import numpy as np
from sweep.plugins import DetectorPlugin, parameter

@dataclass(frozen=True)
class Settings:
    shift_px: float = parameter(0.0, "shift of the corners", unit="px", low=-9, high=9)
    file: str = parameter("", "a file, or none")
    rounds: int = parameter(np.int64(1), "times of search", choices=(1, 2))

class Turned:  # OpenCV's own search, with other conventions
    def __init__(self, settings, family):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
        self.search = cv2.aruco.ArucoDetector(dictionary).detectMarkers
        self.shift = settings.shift_px

    def __call__(self, image):
        corners, ids, _ = self.search(image)
        if ids is None:
            return [], []
        return np.concatenate(corners)[:, [2, 3, 0, 1]] + 0.5 + self.shift, ids.ravel()

TURNED = DetectorPlugin(
    make=Turned, settings=Settings, pixel_center=0.5, corner_order=np.array([2, 3, 0, 1]),
    margin_px=16, distribution="")
"""

GRID = """
[camera]
width_px = 160
height_px = 120
[marker]
size_m = 0.05
[pose]
side_px = 50
[axes]
tilt_deg = [0, 40]
detector = ["opencv", "mine:TURNED"]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    return tmp_path


def refusal(text, **options):
    """The one line that refuses a text."""
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(text, **options)
    (line,) = refused.value.faults
    return line


def test_a_detector_of_other_conventions_gives_opencv_s_corners(folder):
    pipeline = Pipeline.from_text(GRID + "shift_px = [0, 0.25]\n", folder=folder)
    assert pipeline.files.keys() == {"mine.py"}
    columns = run_cells(pipeline, [np.arange(2)]).columns
    # detector x shift_px: a setting that OpenCV does not have changes nothing there.
    opencv, same, plain, shifted = columns["corner_error_px"]
    np.testing.assert_array_equal(opencv, same)
    np.testing.assert_allclose(plain, opencv, rtol=0, atol=1e-5)  # OpenCV's corners are float32
    np.testing.assert_allclose(shifted, opencv + 0.25, rtol=0, atol=1e-5)
    assert (np.array(columns["detection"]) == DetectionStatus.detected).all()


def test_two_plug_ins_share_a_setting_only_if_it_is_declared_equally(folder):
    (folder / "other.py").write_text(MINE)
    both = GRID.replace('"mine:TURNED"]', '"mine:TURNED", "other:TURNED"]\nshift_px = [0, 1]')
    assert len(Pipeline.from_text(both, folder=folder).experiment.detectors) == 6
    (folder / "other.py").write_text(MINE.replace("high=9", "high=8"))
    told = refusal(both, folder=folder)
    assert "expected its setting shift_px to be declared as" in told


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


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder of packages, with one that offers plug-ins."""
    package = tmp_path / "fast_markers"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "detectors.py").write_text(MINE)
    install(tmp_path, "fast-markers", "1.2.3")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
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
        "detector turned: expected fast-markers 1.2.3, not fast-markers 1.3"]
    (plugin,) = pipeline.plugins
    with pytest.raises(PluginError):
        plugin.record(".")


@pytest.mark.usefixtures("site")
def test_names_are_listed_without_an_import(capsys):
    assert main(["plugins"]) == 0
    out = capsys.readouterr().out
    for name in ("turned", "broken"):
        assert f"detector   {name}               of fast-markers" in out
    assert not any(name.startswith("fast_markers") for name in sys.modules)
    assert main(["plugins", "broken"]) == 2
    assert "ModuleNotFoundError: No module named 'fast_markers.nowhere'" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "told"), [
    ("broken", "a plug-in that can be imported: ModuleNotFoundError"),
    ("turnd", "did you mean turn"), ("turned", "fast-markers and slow-markers both have it"),
])
def test_an_installed_plug_in_that_cannot_be_used_is_one_line(name, told, site):
    install(site, "slow-markers", "1.0", "[sweep.detectors]\nturned = slow:D\n")
    line = refusal(INSTALLED.replace("turned", name))
    assert line.startswith(f'pipeline: axes.detector = "{name}": expected ')
    assert told in line


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a pipeline, its plug-in, and its store."""
    folder = tmp_path_factory.mktemp("plugged")
    (folder / "mine.py").write_text(MINE)
    (folder / "grid.toml").write_text(GRID + "[detector]\nshift_px = 0.25\n")
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
        with pytest.raises(StoreError, match=r"files: the store has \{'mine.py': "):
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


FOG = """
from dataclasses import dataclass
from sweep.plugins import EffectPlugin, parameter
@dataclass(frozen=True)
class Settings:
    {name}: float = parameter(0.0, "share of it in the light", low=0, high=1)
E = EffectPlugin(apply=lambda light, patch: {result}, settings=Settings)
"""


def test_effects_and_their_order_make_another_experiment(tmp_path):
    for name, level in (("fog", 200), ("smoke", 20)):
        result = f'light + patch.values["{name}"] * ({level} - light)'
        (tmp_path / f"{name}.py").write_text(FOG.format(name=name, result=result))
    clear = "[pose]\nside_px = 50\ntilt_deg = 30\n[camera]\nwidth_px = 160\nheight_px = 120\n"
    first, second, without = (
        Pipeline.from_text(f"{effects}{clear}{scene}", folder=tmp_path)
        for effects, scene in (
            ('effects = ["fog:E", "smoke:E"]\n', "[scene]\nfog = 0.3\nsmoke = 0.2\n"),
            ('effects = ["smoke:E", "fog:E"]\n', "[scene]\nfog = 0.3\nsmoke = 0.2\n"), ("", "")))
    assert (scene_image(first) != scene_image(second)).any()
    store = by_hand(str(tmp_path / "first.zarr"), first)
    for other in (second, without):
        assert any(line.startswith("effects: ")
                   for line in differences(other, store.pipeline, store.fingerprint))
        with pytest.raises(StoreError, match="no cell of it can be reused"):
            match(other, store)
    assert not differences(first, store.pipeline, store.fingerprint)


BAD_DETECTOR = """
import os
import numpy as np

ONE = np.zeros((1, 4, 2))

def at_marker(settings, family):
    return lambda image: {returned} if image.max() > 200 else ([], [])

D = {made}
"""


@pytest.fixture
def bad(tmp_path):
    """Return a function that makes a pipeline with a detector that returns this at a marker."""
    def written(returned="([], [])", made="at_marker"):
        (tmp_path / "bad.py").write_text(BAD_DETECTOR.format(returned=returned, made=made))
        text = GRID.replace("tilt_deg = [0, 40]\n", "").replace("mine:TURNED", "bad:D")
        return Pipeline.from_text(text, folder=tmp_path)

    return written


@pytest.mark.parametrize(("returned", "told"), [
    ("(ONE * np.nan, [0])", "returned corners that are not finite"),
    ("(ONE[0], [0])", "returned corners of shape (4, 2); expected (n, 4, 2)"),
    ("(np.zeros((10000, 4, 2)), np.zeros(10000, int))",
     "returned 10,000 corners for one image; expected at most 1,000"),
    ("(np.ma.masked_array(ONE, mask=True), [0])",
     "returned corners of which some are masked; expected NaN or none"),
    ("(ONE, [0.0])", "returned ids of type float64; expected whole numbers"),
    ("(ONE, [-1])", "returned the ID -1; expected at least 0"),
    ("None", "returned a NoneType; expected a tuple of two, (corners, ids), or of three"),
    ("(image.fill(0), ([], []))[1]", "changed the image that it was given; copy it first"),
    ("open('model.onnx')", "raises FileNotFoundError"),
    ("os.sys.exit(3)", "raises SystemExit: 3"),
])
def test_an_image_at_which_a_detector_is_at_fault_is_flagged(bad, returned, told):
    pipeline = bad(returned)
    try_plugins(pipeline)  # on a blank frame nothing is wrong
    cells = run_cells(pipeline, [])
    assert [flags.tolist() for flags in cells.columns["detection"]] == [
        [DetectionStatus.detected], [DetectionStatus.failed]]
    (failure,) = cells.failures
    assert (failure.stage, failure.setting) == ("detection", 1)
    assert f"PluginError: bad:D: {told}" in failure.text.splitlines()[-1]


def test_too_little_memory_names_the_plug_in_whose_own_interrupt_is_its_fault_in_a_worker():
    with pytest.raises(MemoryError, match="bad:full: raises MemoryError"):
        call("bad:full", mock.Mock(side_effect=MemoryError))
    interrupted = mock.Mock(side_effect=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):  # as the user's
        call("bad:interrupted", interrupted)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as workers are
    try:
        with pytest.raises(PluginError, match="raises KeyboardInterrupt"):
            call("bad:interrupted", interrupted)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("made", "told"), [
    ("lambda settings, family: 1 / 0", "raises ZeroDivisionError: division by zero"),
    ("lambda settings, family: 3", "make returns a int, not a function"),
])
def test_a_detector_that_cannot_be_made_refuses_the_run(bad, made, told):
    with pytest.raises(PluginError) as refused:
        check_plugins(Here(), bad(made=made))
    assert str(refused.value) == f"bad:D: {told}"


def test_what_a_function_margin_px_raises_is_the_plug_in_s_fault(bad):
    made = "__import__('sweep').plugins.DetectorPlugin(make=print, margin_px=lambda _: exit(3))"
    *_, setting = bad(made=made).experiment.detectors
    with pytest.raises(PluginError, match="bad:D: margin_px: raises SystemExit: 3"):
        full_frame_reason(setting)


@pytest.mark.parametrize(("source", "told"), [
    ("x =", "SyntaxError"),
    ("D = 3", "a record DetectorPlugin, not a value of type int"), ("", "a name in mine.py"),
    ("import beside_it\nD = print", "imports beside_it.py beside it; put both"),
    ("from sweep.plugins import DetectorPlugin\nD = DetectorPlugin(make=1)",
     "ValueError: make = 1: expected a class or function (line 2 of mine.py)"),
    (MINE.replace("high=9", "high=-1").replace("TURNED", "D"), "expected a number from -9 to -1"),
    (MINE.replace("(1, 2)", "'ab'").replace("TURNED", "D"), "rounds: expected choices that are n"),
    ("from sweep.plugins import *\nD = DetectorPlugin(make=print, distribution='not-there-9')",
     "the distribution not-there-9, which is not installed: `pip install not-there-9`"),
    ("from sweep.plugins import *\nD = DetectorPlugin(make=print, corner_order=(0., 1., 2., 3.))",
     "corner_order = (0.0, 1.0, 2.0, 3.0): expected the numbers 0 to 3, each once (line 2"),
    ("from sweep.plugins import *\nimport numpy\nD = EffectPlugin(apply=print, step=numpy.ones(2))",
     "step = array([1., 1.]): expected light or signal (line 3"),
    (MINE.replace("shift_px", "tilt_deg").replace("TURNED", "D"),
     "another name for its setting tilt_deg: the pipeline has this one"),
])
def test_a_plug_in_that_cannot_be_used_is_one_line(tmp_path, source, told, monkeypatch):
    (tmp_path / "mine.py").write_text(source)
    (tmp_path / "beside_it.py").write_text("value = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    text = '[pose]\nside_px = 24\n[detector]\ndetector = "mine:D"\nits_setting = 3\n'
    for _ in range(2):
        line = refusal(text, folder=tmp_path)
        assert line.startswith('pipeline: detector.detector = "mine:D": expected ')
        assert told in line


POSE = "[pose]\nside_px = 24\n"


@pytest.mark.parametrize(("text", "told"), [
    (GRID + "shift_px = [0, 10]",
     "axes.shift_px = [0, 10]: expected a number from -9 to 9 (not 10)"),
    (GRID + "shift_pixels = [0, 10]", "unknown key; did you mean shift_px?"),
    (POSE + '[detector]\ndetector = "nowhere:D"',
     'detector.detector = "nowhere:D": expected the file nowhere.py in'),
    (POSE + '[detector]\ndetector = "apriltagg"', "expected an installed detector plug-in"),
    (POSE + '[estimator]\nsolver = "ippee"', "did you mean ippe?"),
    ('effects = ["fog"]\n' + POSE, "expected an installed effect"),
    ('effects = "fog"\n' + POSE, "expected a list of plug-ins, each once"),
])
def test_names_and_settings_of_plug_ins_that_are_not_there(text, told, folder):
    assert told in refusal(text, folder=folder)


BAD_SOLVER = """
import numpy as np

EYE = np.diag([1.0, -1.0, -1.0])

def poses(count, rotation=EYE, depth=0.4):
    return np.tile(rotation, (count, 1, 1)), np.tile([0, 0, depth], (count, 1))

def solve(detections):
    n = len(detections.corners)
    return {returned}

S = lambda settings: solve
"""


@pytest.mark.parametrize(("returned", "status", "told"), [
    ("(poses(n)[0] * np.nan, poses(n)[1])", EstimateStatus.solver_failed, None),
    ("poses(n, depth=4.0)", EstimateStatus.solver_failed, None),
    ("poses(n, np.eye(3) * [1, 1, -1])", EstimateStatus.failed,
     "returned a rotation that is no rotation matrix"),
    ("None", EstimateStatus.failed, "returned a NoneType; expected a tuple"),
    ("(*poses(n), None, poses(n)[0])", EstimateStatus.failed, "returned half an alternative"),
])
def test_a_solver_s_faults_never_pass_as_solved(tmp_path, returned, status, told):
    (tmp_path / "bad.py").write_text(BAD_SOLVER.format(returned=returned))
    text = '[pose]\nside_px = 60\n[axes]\nsolver = ["ippe", "bad:S"]\n'
    cells = run_cells(Pipeline.from_text(text, folder=tmp_path), [])
    assert [flags[0] for flags in cells.columns["estimate"]] == [EstimateStatus.solved, status]
    assert np.isnan(cells.columns["rotation_error_rad"][1]).all()
    lines = [failure.text.splitlines()[-1] for failure in cells.failures]
    assert len(lines) == (told is not None)
    assert all(f"PluginError: bad:S: {told}" in line for line in lines)


@pytest.mark.parametrize(("result", "told"), [
    ("light * float('nan')", "returned levels that are not finite"),
    ("light[1:]", "returned levels of shape"), ("None", "returned levels of type object"),
    ("1 / 0", "raises ZeroDivisionError"),
])
def test_an_effect_s_faults_are_its_scene_s(tmp_path, result, told):
    (tmp_path / "bad.py").write_text(FOG.format(name="fog", result=result))
    text = 'effects = ["bad:E"]\n[pose]\nside_px = 60\n[axes]\nfog = [0, 0.5]\n'
    cells = run_cells(Pipeline.from_text(text, folder=tmp_path), [np.arange(2)])
    assert cells.columns["detection"][0].tolist() == [
        DetectionStatus.detected, DetectionStatus.failed]
    (failure,) = cells.failures
    assert told in failure.text.splitlines()[-1]


def test_costs_are_counted_by_a_clock_that_sees_all_that_works(bad):
    detectors = bad().experiment.detectors
    assert clock_of(detectors[:1]) is time.thread_time
    assert clock_of(detectors) is time.process_time


def test_a_worker_says_which_plug_ins_it_lacks(bad, tmp_path):
    pipeline = bad()
    begun = fingerprint(pipeline)
    assert other_here(pipeline, begun) == []
    content = (tmp_path / "bad.py").read_text()
    (tmp_path / "bad.py").unlink()
    (line,) = other_here(pipeline, begun)
    assert line.startswith(f"detector bad:D: expected the file bad.py in {tmp_path}")
    (tmp_path / "bad.py").write_text(content + "# changed\n")
    (line,) = other_here(pipeline, begun)
    assert "bad.py as it was when the run began" in line
