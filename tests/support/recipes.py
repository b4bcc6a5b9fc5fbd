"""A copy of the package with some lines more: what a recipe of the developers' guide asks for."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import sweep

PACKAGE = Path(sweep.__file__).parent
TESTS = Path(__file__).parent.parent


def added(folder, *changes):
    """Copy the package to a folder; each change (file, anchor, text) puts text after an anchor.

    An anchor stands once in its file; without one, the file is new.
    """
    shutil.copytree(PACKAGE, folder / "sweep")  # with its compiled code, for unchanged sources
    for file, anchor, text in changes:
        path = folder / "sweep" / file
        if anchor is None:
            path.write_text(text, encoding="utf-8")
            continue
        source = path.read_text(encoding="utf-8")
        assert source.count(anchor) == 1, f"{file}: {anchor!r} stands {source.count(anchor)} times"
        path.write_text(source.replace(anchor, anchor + text), encoding="utf-8")
    return folder


def printed_by(folder, script):
    """Run a script with the package in a folder; return its last line, read as JSON."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(TESTS)])}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, cwd=folder,
        capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
