"""Faults of a machine are raised, and never become a scene's flag; threads are the caller's."""

import errno
import pickle
import socket

import cv2
import numpy as np
import pytest
from numba.core.errors import TypingError

import sweep
from support import machine_faults
from support.blocks import run_cells
from sweep.errors import MachineFaultError, StoreError
from sweep.evaluation.block import warm_up
from sweep.evaluation.inspection import inspect_scene
from sweep.evaluation.machine_faults import machine_fault
from sweep.experiment.pipeline import cell

PIPELINE = sweep.Pipeline.from_dict(
    {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 4}}
)


@pytest.mark.parametrize("error", [
    OSError(errno.EMFILE, "Too many open files"), MemoryError(), ImportError("no libc"), EOFError(),
    pickle.PicklingError(), pickle.UnpicklingError(), TypingError("x"), PermissionError("no"),
    RuntimeError("can't start new thread"), machine_faults.ERRORS["opencv memory"](),
], ids=lambda error: type(error).__name__)
def test_faults_of_a_machine_are_told_from_results(error):
    begin = f"machine fault on {socket.gethostname()}: {type(error).__name__}"
    assert str(machine_fault(error)).startswith(begin)
    outer = ValueError("raised while the other was handled")
    outer.__context__ = error
    assert str(machine_fault(outer)).startswith(begin)


def test_what_data_may_cause_is_no_fault_of_the_machine():
    with pytest.raises(cv2.error) as raised:
        cv2.cvtColor(np.zeros((0, 0), np.uint8), 4)
    assert machine_fault(raised.value) is None
    for error in (ValueError(), np.linalg.LinAlgError(), RuntimeError("poisoned"), StoreError("x"),
                  ZeroDivisionError(), AssertionError()):
        assert machine_fault(error) is None
    hidden = ValueError("of the data")
    hidden.__context__, hidden.__suppress_context__ = OSError("handled"), True
    assert machine_fault(hidden) is None


@pytest.mark.parametrize(("place", "fault", "work", "named"), [
    *((place, fault, lambda: run_cells(PIPELINE, [np.arange(4)]), None)
      for place in machine_faults.PLACES if place != "set"
      for fault in ("disk", "memory", "import", "compiler", "opencv memory")),
    *((place, "import", lambda: warm_up(PIPELINE), "file too short")  # before any block
      for place in ("render_all", "build")),
])
def test_a_fault_of_the_machine_is_told_as_one_and_flags_no_scene(place, fault, work, named):
    warm_up(PIPELINE)
    machine_faults.inject(fault, place, 0)
    try:
        with pytest.raises(MachineFaultError, match=named):
            work()
    finally:
        machine_faults.clear()
    assert not run_cells(PIPELINE, [np.arange(4)]).failures


# The caller's number of OpenCV threads is its own again after a call.


@pytest.mark.parametrize("call", [
    lambda: run_cells(PIPELINE, [np.arange(1)]), lambda: inspect_scene(cell(PIPELINE, "trial=0")),
])
def test_a_call_leaves_the_number_of_threads_as_it_was(call):
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    call()
    left = cv2.getNumThreads()
    cv2.setNumThreads(before)
    assert left == 2
