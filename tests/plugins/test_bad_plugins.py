"""Plug-ins at fault: a line each, and what others computed is not lost."""

from __future__ import annotations

import signal
import time
from unittest import mock

import numpy as np
import pytest

from support.blocks import run_cells
from support.here import Here
from sweep.errors import PipelineError, PluginError
from sweep.execution.block_task import other_here
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.crash_isolation import check_plugins, use
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins.loading import call
from sweep.store.provenance import fingerprint
from sweep.tradeoff.costs import clock_of

DETECTOR = """
import os
import numpy as np

ONE = np.zeros((1, 4, 2))

def at_marker(settings, family):
    return lambda image: {returned} if image.max() > 200 else ([], [])

D = {made}
"""

GRID = """
[camera]
width_px = 128
height_px = 96
[marker]
size_m = 0.05
[pose]
side_px = 48
[axes]
detector = ["opencv", "bad:D"]
"""


@pytest.fixture
def pipeline(tmp_path):
    """Return a function that makes a pipeline with a detector that returns this at a marker."""
    def written(returned="([], [])", made="at_marker"):
        (tmp_path / "bad.py").write_text(DETECTOR.format(returned=returned, made=made))
        return Pipeline.from_text(GRID, folder=tmp_path)

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
    ("None", "returned a NoneType; expected a tuple (corners, ids)"),
    ("(image.fill(0), ([], []))[1]", "changed the image that it was given; copy it first"),
    ("open('model.onnx')", "raises FileNotFoundError"),
    ("os.sys.exit(3)", "raises SystemExit: 3"),
])
def test_an_image_at_which_a_detector_is_at_fault_is_flagged(pipeline, returned, told):
    bad = pipeline(returned)
    use(bad, "detector", "bad:D")  # on a blank frame nothing is wrong
    cells = run_cells(bad, [])
    assert [flags.tolist() for flags in cells.columns["detection"]] == [
        [DetectionStatus.detected], [DetectionStatus.failed],
    ]
    (failure,) = cells.failures
    assert (failure.stage, failure.setting) == ("detection", 1)
    assert f"PluginError: bad:D: {told}" in failure.text.splitlines()[-1]


def test_an_interrupt_that_a_plug_in_raises_itself_is_its_fault_in_a_worker():
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
def test_a_detector_that_cannot_be_made_refuses_the_run(pipeline, made, told):
    with pytest.raises(PluginError) as refused:
        check_plugins(Here(), pipeline(made=made))
    assert str(refused.value) == f"bad:D: {told}"


@pytest.mark.parametrize(("source", "told"), [
    ("import missing_library", "missing_library"),
    ("x =", "SyntaxError"),
    ("D = 3", "a record DetectorPlugin, not a value of type int"),
    ("", "a name in mine.py"),
    ("from sweep.plugins import DetectorPlugin\nD = DetectorPlugin(make=1)",
     "TypeError: make: expected a class or function of settings and family (line 2 of mine.py)"),
    ("from sweep.plugins import *\nD = DetectorPlugin(make=print, distribution='not-there-9')",
     "the distribution not-there-9, which is not installed: `pip install not-there-9`"),
    ("""
from dataclasses import dataclass
from sweep.plugins import DetectorPlugin, parameter
@dataclass
class Settings:
    tilt_deg: float = parameter(0.0, "ours")
D = DetectorPlugin(make=print, settings=Settings)
""", "another name for its setting tilt_deg: the pipeline has this one"),
])
def test_a_plug_in_that_cannot_be_used_is_one_line(tmp_path, source, told):
    (tmp_path / "mine.py").write_text(source)
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(
            '[pose]\nside_px = 24\n[detector]\ndetector = "mine:D"\nits_setting = 3\n',
            folder=tmp_path,
        )
    (line,) = refused.value.faults
    assert line.startswith('pipeline: detector.detector = "mine:D": expected ')
    assert told in line


def test_a_plug_in_is_one_file(tmp_path, monkeypatch):
    (tmp_path / "beside_it.py").write_text("value = 3\n")
    (tmp_path / "mine.py").write_text("import beside_it\nD = print\n")
    monkeypatch.syspath_prepend(tmp_path)
    for _ in range(2):
        with pytest.raises(PipelineError, match=r"imports beside_it\.py beside it; put both"):
            Pipeline.from_text(
                '[pose]\nside_px = 24\n[detector]\ndetector = "mine:D"\n', folder=tmp_path
            )


@pytest.mark.parametrize(("text", "told"), [
    ('[detector]\ndetector = "nowhere:D"',
     'detector.detector = "nowhere:D": expected the file nowhere.py in'),
    ('[detector]\ndetector = "apriltagg"', "expected an installed detector plug-in"),
    ('[estimator]\nsolver = "ippee"', "did you mean ippe?"),
    ('[scene]\nrenderer = "nowhere:R"', "expected the file nowhere.py in"),
    ('effects = ["fog"]', "expected an installed effect"),
    ('effects = "fog"', "expected a list of plug-ins, each once"),
])
def test_names_of_plug_ins_that_are_not_there(text, told, tmp_path):
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(f"{text}\n[pose]\nside_px = 24\n", folder=tmp_path)
    (line,) = refused.value.faults
    assert told in line


SOLVER = """
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
    ("poses(n, depth=-0.4)", EstimateStatus.solver_failed, None),
    ("poses(n, depth=4.0)", EstimateStatus.solver_failed, None),
    ("poses(n, np.eye(3) * [1, 1, -1])", EstimateStatus.failed,
     "returned a rotation that is no rotation matrix"),
    ("poses(n + 1)", EstimateStatus.failed,
     "returned a rotation of shape (2, 3, 3); expected (1, 3, 3)"),
    ("None", EstimateStatus.failed, "returned a NoneType; expected a tuple"),
    ("(*poses(n), None, poses(n)[0])", EstimateStatus.failed, "returned half an alternative"),
])
def test_a_solver_s_faults_never_pass_as_solved(tmp_path, returned, status, told):
    (tmp_path / "bad.py").write_text(SOLVER.format(returned=returned))
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
    (tmp_path / "bad.py").write_text(f"""
from dataclasses import dataclass
from sweep.plugins import EffectPlugin, parameter
@dataclass
class Settings:
    fog: float = parameter(0.0, "strength", low=0, high=1)
E = EffectPlugin(apply=lambda light, patch: {result}, settings=Settings)
""")
    text = 'effects = ["bad:E"]\n[pose]\nside_px = 60\n[axes]\nfog = [0, 0.5]\n'
    cells = run_cells(Pipeline.from_text(text, folder=tmp_path), [np.arange(2)])
    assert cells.columns["detection"][0].tolist() == [
        DetectionStatus.detected, DetectionStatus.failed,
    ]
    (failure,) = cells.failures
    assert told in failure.text.splitlines()[-1]


def test_costs_are_counted_by_a_clock_that_sees_all_that_works(tmp_path):
    (tmp_path / "mine.py").write_text("def D(settings, family): return lambda image: ([], [])\n")
    text = '[pose]\nside_px = 24\n[axes]\ndetector = ["opencv", "mine:D"]\n'
    settings = Pipeline.from_text(text, folder=tmp_path).experiment.detectors
    assert clock_of(settings[:1]) is time.thread_time
    assert clock_of(settings) is time.process_time


def test_a_worker_says_which_plug_ins_it_lacks(pipeline, tmp_path):
    bad = pipeline()
    begun = fingerprint(bad)
    assert other_here(bad, begun) == []
    content = (tmp_path / "bad.py").read_text()
    (tmp_path / "bad.py").unlink()
    (line,) = other_here(bad, begun)
    assert line.startswith(f"detector bad:D: expected the file bad.py in {tmp_path}")
    (tmp_path / "bad.py").write_text(content + "# changed\n")
    (line,) = other_here(bad, begun)
    assert "bad.py as it was when the run began" in line
