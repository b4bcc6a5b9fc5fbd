"""Detectors in other Pythons give what they give in process, and their faults are contained."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from support.stub_opencv import script, stub_python
from sweep.environments.identity import process_of
from sweep.environments.process import DetectorProcess, DetectorProcessError, SearchDefinition
from sweep.errors import EnvironmentFaultError, MachineFaultError, PipelineError
from sweep.evaluation.cells import run_cells
from sweep.measure.flags import DetectionStatus
from sweep.plan.experiment import Pipeline
from sweep.store.provenance import changes, fingerprint

SEARCH = SearchDefinition("DICT_5X5_50", (("cornerRefinementMethod", "NONE"),))

GRID = """
[marker]
size_m = 0.05
[axes]
side_px = [60]
white = [255, 200]
"""

PAIRED = """
[pose]
side_px = {{ uniform = [12, 90] }}
tilt_deg = {{ uniform = [0, 60] }}
azimuth_deg = {{ uniform = [0, 360] }}
jitter_px = 0.5
[scene]
noise_grey = 2
window = "{window}"
[axes]
dictionary = ["DICT_5X5_50", "DICT_APRILTAG_36h11"]
trial = {count}
environment = ["installed", "{python}"]
cornerRefinementMethod = ["none", "subpix", "contour", "apriltag"]
"""


@pytest.fixture(scope="module")
def stub(tmp_path_factory):
    return stub_python(tmp_path_factory.mktemp("stub"))


def grey(level, shape=(6, 8)):
    return np.full(shape, level, np.uint8)


def cells(pipeline):
    shape = [len(axis) for axis in pipeline.axes if axis.stage.name == "scene"]
    return run_cells(pipeline, [index.ravel() for index in np.indices(shape)])


@pytest.mark.parametrize(("window", "count"), [("auto", 24), ("full", 3)])
def test_this_python_through_its_own_process_gives_the_same_bits(window, count):
    pipeline = Pipeline.from_text(
        PAIRED.format(window=window, count=count, python=sys.executable))
    result = cells(pipeline)
    assert not result.failures
    assert (result.columns["detection"][0] == DetectionStatus.detected).any()
    for name, columns in result.columns.items():
        half = len(columns) // 2
        if half:
            for here, there in zip(columns[:half], columns[half:], strict=True):
                assert here.tobytes() == there.tobytes(), name


def test_images_of_any_shape_arrive_as_they_are(stub):
    process = DetectorProcess(stub)
    shapes = [(5, 9), (700, 1900), (8, 8)]
    images = [grey(9, shape)[:, ::-1] for shape in shapes]
    for answer, (height, width) in zip(process.search(images, [SEARCH] * 3), shapes, strict=True):
        assert answer.corners[0, 2].tolist() == [width, height]
        assert answer.ids.tolist() == [7]
        assert answer.rejected[:, 0, 0].tolist() == [1, 2]
    process.close()
    with pytest.raises(DetectorProcessError):
        process.search(images, [SEARCH] * 3)


def test_process_ends_if_the_one_that_started_it_is_killed_amid_a_search(stub):
    program = (
        "import sys, numpy as np\n"
        "from sweep.environments.process import DetectorProcess, SearchDefinition\n"
        f"process = DetectorProcess({stub!r})\n"
        "print(process._process.pid, flush=True)\n"
        "image = np.full((6, 8), 203, np.uint8)\n"
        "process.search([image], [SearchDefinition('DICT_5X5_50', ())])\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as worker:
        child = int(worker.stdout.readline())
        time.sleep(0.2)
        assert Path(f"/proc/{child}/stat").exists() or sys.platform != "linux"
        worker.send_signal(signal.SIGKILL)
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{child}/stat").read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    raise AssertionError(child)


@pytest.mark.parametrize(("command", "expected"), [
    ("cat", "is no Python from 3.8 on that works: it says nothing within 0.5 s"),
    ("true", "is no Python from 3.8 on that works: exit status 0"),
    ("echo out of order >&2; exit 3", "out of order"),
    ("kill -SEGV $$", "SIGSEGV"),
    ("yes", "is no Python from 3.8 on that works"),
    (f'exec "{sys.executable}" -S "$@"', "has no NumPy that can be imported"),
])
def test_what_is_no_detectors_python_is_told_in_a_line(tmp_path, monkeypatch, command, expected):
    if command == "cat":
        monkeypatch.setattr("sweep.environments.process.START_S", 0.5)
    with pytest.raises(EnvironmentFaultError) as told:
        DetectorProcess(script(tmp_path / "python", command))
    assert expected in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(("text", "expected"), [
    ("raise ImportError('libGL.so.1: cannot open')", "OpenCV that can be imported: ImportE"),
    ("__version__ = '4.5.0'", "has OpenCV 4.5.0 without ArUco"),
])
def test_an_opencv_that_does_not_do_is_told_in_a_line(tmp_path, text, expected):
    with pytest.raises(EnvironmentFaultError, match=expected):
        DetectorProcess(stub_python(tmp_path, text))


@pytest.mark.parametrize(("environment", "expected"), [
    ("opencv-9", "no environment of this name"),
    ("./nowhere/python", "no file"),
    (".", "has no bin/python"),
    ("pyproject.toml", "no environment of this name"),
    ("./pyproject.toml", "cannot be started: Permission denied"),
])
def test_an_environment_that_cannot_be_used_is_a_fault_of_the_pipeline(environment, expected):
    with pytest.raises(PipelineError) as told:
        Pipeline.from_text(GRID, [f"environment={environment!r}"], folder=Path(__file__).parents[2])
    (line,) = told.value.faults
    assert expected in line


@pytest.mark.parametrize(("settings", "expected"), [
    (["validBitIdThreshold=0.3"], "a field that OpenCV 4.5.0 of environment "),
    (["dictionary=['DICT_5X5_50', 'DICT_6X6_50']"], "one that OpenCV 4.5.0 of environment "),
    (["detector='own:search'"], "installed for detectors other than opencv"),
])
def test_what_another_opencv_lacks_is_said_before_the_run(tmp_path, stub, settings, expected):
    (tmp_path / "own.py").write_text("def search(*_):\n    return lambda _: ([], [])\n")
    with pytest.raises(PipelineError) as told:
        Pipeline.from_text(GRID, [f"environment={stub!r}", *settings], folder=tmp_path)
    assert expected in str(told.value)


def test_other_markers_under_the_same_name_are_refused(tmp_path):
    stub = stub_python(tmp_path)
    markers = np.load(tmp_path / "markers.npy")
    markers[3, 0, 0] ^= 1
    np.save(tmp_path / "markers.npy", markers)
    with pytest.raises(PipelineError, match=r"the same markers in OpenCV 4\.5\.0"):
        Pipeline.from_text(GRID, [f"environment={stub!r}"])


def test_a_search_that_ends_its_process_or_raises_costs_its_own_cell_alone(stub):
    pipeline = Pipeline.from_text(
        GRID, [f"environment={stub!r}", "white=[255, 201, 200, 202, 199]"])
    result = cells(pipeline)
    wrong, crashed, failed = (
        DetectionStatus.wrong_id, DetectionStatus.crashed, DetectionStatus.failed)
    assert result.columns["detection"][0].tolist() == [wrong, crashed, wrong, failed, wrong]
    dead, raised = sorted(result.failures, key=lambda failure: failure.scene)
    assert dead.crashed
    assert dead.text.endswith("ended: SIGSEGV")
    assert not raised.crashed
    assert raised.text == "cv2.error: no such image"


def test_a_process_that_ended_is_replaced_and_others_are_kept(stub):
    first, other = process_of(stub), process_of(sys.executable)
    first.close()
    assert process_of(stub) is not first
    assert process_of(stub) is process_of(stub)
    assert process_of(sys.executable) is other


@pytest.mark.parametrize("level", [204, 205])
def test_a_process_that_is_killed_or_lacks_memory_is_the_machines_fault(stub, level):
    pipeline = Pipeline.from_text(GRID, [f"environment={stub!r}", f"white=[255, {level}]"])
    with pytest.raises(MachineFaultError):
        cells(pipeline)


def test_the_fingerprint_has_what_an_environments_results_depend_on(stub):
    alone = fingerprint(Pipeline.from_text(GRID))
    assert "environments" not in alone
    beside = fingerprint(Pipeline.from_text(GRID, [f"environment=['installed', {stub!r}]"]))
    (text,) = beside["environments"].values()
    assert text.startswith("OpenCV 4.5.0 ")
    assert text.endswith(", minMarkerDistanceRate 0.05")
    assert not list(changes(alone, beside))  # cells of either grid are the other's
    given = fingerprint(
        Pipeline.from_text(GRID, [f"environment={stub!r}", "minMarkerDistanceRate=0.125"]))
    assert [key for key, _, _ in changes(beside, given)] == [f"environments.{stub}"]


def test_a_store_is_read_without_its_environment_and_says_why_it_cannot_be_computed(
    tmp_path, stub
):
    pipeline = Pipeline.from_text(GRID, [f"environment={stub!r}"])
    recorded = fingerprint(pipeline)
    text = pipeline.text.replace(stub, str(tmp_path / "gone"))
    stored = Pipeline.from_text(text, plugins=())
    recorded["environments"] = {str(tmp_path / "gone"): recorded["environments"][stub]}
    ((key, _, own),) = changes(recorded, fingerprint(stored))
    assert key.startswith("environments.")
    assert own.startswith("none (no file ")
