"""Threads that the system allows: too few for a cluster are told before it is started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sweep.errors import RunError
from sweep.execution import cluster as thread_limit
from sweep.execution.cluster import check_threads, threads_left
from sweep.isolation import machine as groups

TOP = Path(__file__).parents[2]

LEFT = """
import os
from sweep.execution import cluster as thread_limit
{change}
print(thread_limit.threads_left(), len(os.listdir("/proc/self/task")))
"""


def allowed(user, limit, change=""):
    """Return what is left of a limit, and the threads, of a process of a user without others.

    The process may read all files. Libraries that it imports start threads, one a core.
    """
    kept = "+dac_override,+dac_read_search"
    done = subprocess.run(
        ["setpriv", f"--reuid={user}", "--clear-groups", f"--inh-caps={kept}",
         f"--ambient-caps={kept}", "bash", "-c", f"ulimit -u {limit}; exec {sys.executable} -"],
        input=LEFT.format(change=change), capture_output=True, text=True, check=False, timeout=60,
        env={**os.environ, "PYTHONPATH": str(TOP)},
    )
    assert done.returncode == 0, done.stderr
    left, threads = done.stdout.split()
    return left, int(threads)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become another user")
def test_threads_of_a_user_count_against_the_limit():
    user = 1_000_000_000 + os.getpid()  # nobody else's, whatever else runs on this machine
    left, threads = allowed(user, 60)
    assert int(left) == 60 - threads
    # As if reading all files were a privilege that exempts.
    assert allowed(user, 60, "thread_limit.PRIVILEGES = 1 << 1")[0] == "None"


@pytest.fixture
def container(tmp_path, monkeypatch):
    """The files of a container's control group, version 2, below the group that is limited."""
    inner = tmp_path / "pod" / "inner"
    inner.mkdir(parents=True)
    text_of = groups.text_of
    monkeypatch.setattr(groups, "MOUNT", tmp_path)
    monkeypatch.setattr(groups, "text_of", lambda path: (
        "0::/pod/inner\n" if str(path) == "/proc/self/cgroup" else text_of(path)
    ))
    return tmp_path / "pod"


def test_limits_of_a_container_are_read(container, monkeypatch):
    monkeypatch.setattr(thread_limit, "_left_to_user", lambda: None)
    (container / "inner" / "pids.max").write_text("max\n")
    assert threads_left() is None
    (container / "pids.max").write_text("50\n")
    (container / "pids.current").write_text("12\n")
    assert threads_left() == 38
    check_threads(2)
    with pytest.raises(RunError, match=r"3 worker processes .* need 45 threads, .* allows 38 more"):
        check_threads(3)
