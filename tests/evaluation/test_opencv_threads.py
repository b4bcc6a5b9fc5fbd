"""The caller's number of OpenCV threads is its own again after a call."""


import cv2
import pytest

from support.blocks import run_cells
from sweep.evaluation.inspection import inspect_scene
from sweep.experiment.pipeline import Pipeline

PIPELINE = Pipeline.from_dict({"pose": {"distance_m": 0.5}, "marker": {"size_m": 0.1}})


@pytest.fixture
def two_threads():
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("call", [lambda: run_cells(PIPELINE, []), lambda: inspect_scene(PIPELINE)])
def test_a_call_leaves_the_number_of_threads_as_it_was(call):
    call()
    assert cv2.getNumThreads() == 2
