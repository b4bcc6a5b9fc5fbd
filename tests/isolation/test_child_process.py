"""Calls in a child process: it may raise, die, stall, or print, and the caller goes on."""

import copy
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from sweep.errors import PipelineError, StoreError
from sweep.experiment.pipeline import Pipeline
from sweep.isolation import child_process
from sweep.isolation.child_process import Child, ChildDiedError, ChildError

pytestmark = pytest.mark.system


def test_child_calls_functions_and_tells_what_they_raise():
    with Child() as child:
        assert child.call(pow, 2, 10, limit_s=60) == 1024
        with pytest.raises(ChildError, match="ZeroDivisionError"):
            child.call(divmod, 1, 0, limit_s=60)
        with pytest.raises(PipelineError) as told:
            child.call(Pipeline.from_text, "[pose]\nroll = 1", limit_s=60)
        assert len(told.value.faults) == 2
        child.call(signal.raise_signal, signal.SIGINT, limit_s=60)  # the caller's to act on
        for error in (PipelineError(["one", "two"]), StoreError("one line")):  # crosses as it is
            again = child.call(copy.copy, error, limit_s=60)
            assert (type(again), str(again), again.__dict__) == (
                type(error), str(error), error.__dict__)
        # It lives on, and what is printed does not get among its answers.
        assert child.call(os.system, "echo noise", limit_s=60) == 0
        large = np.arange(3_000_000.0)
        np.testing.assert_array_equal(child.call(np.negative, large, limit_s=60), -large)


@pytest.mark.parametrize(("function", "arguments", "limit_s", "how"), [
    (signal.raise_signal, (signal.SIGSEGV,), 60, "SIGSEGV"),
    (os._exit, (3,), 60, "exit status 3"),
    (pow, (3, 10**9), 0.5, "time limit of 0.5 s"),  # it keeps the interpreter's lock
])
def test_child_that_dies_says_how(function, arguments, limit_s, how):
    with Child() as child, pytest.raises(ChildDiedError, match=how):
        child.call(function, *arguments, limit_s=limit_s)


def test_call_that_a_child_does_not_read_ends_in_time(tmp_path, monkeypatch):
    (tmp_path / "stuck.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(child_process, "GRACE_S", 0.2)
    with Child("stuck") as child, pytest.raises(ChildDiedError, match="time limit"):
        child.call(np.negative, np.zeros(3_000_000), limit_s=0.2)


def test_a_process_ends_with_its_parent_even_one_that_ended_before():
    child = ("import sys, time; from sweep.isolation.child_process import end_with; "
             "end_with(int(sys.argv[1])); time.sleep(600)")
    parent = "import os, subprocess, sys; subprocess.Popen(["
    parent += f"sys.executable, '-c', {child!r}, str(os.getpid())])"
    # The child has the output, too, whose end is waited for.
    subprocess.run([sys.executable, "-c", parent], capture_output=True, check=True, timeout=120)


def test_child_runs_nothing_that_lies_in_the_current_folder(tmp_path):
    for name in ("json", "pickle", "enum", "numpy"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w').close()\n")
    script = tmp_path / "script" / "call.py"
    script.parent.mkdir()
    script.write_text("from sweep.isolation.child_process import Child\nwith Child() as child:\n"
                      "    print(child.call(pow, 2, 3, limit_s=60))\n")
    ran = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=True,
        timeout=120)
    assert ran.stdout == "8\n"
    assert not (tmp_path / "ran").exists()
