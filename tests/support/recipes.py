"""A copy of the package with some lines more: what a recipe of the developers' guide asks for."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import sweep
from sweep.compilation import cache_folder

PACKAGE = Path(sweep.__file__).parent


def added(folder, *changes):
    """Copy the package to a folder; each change (file, anchor, text) puts text after an anchor.

    An anchor stands once in its file; without one, the file is new.
    """
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(PACKAGE, folder / "sweep", ignore=ignored)
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
    """Run a script with the package in a folder; return what it prints, read as JSON.

    Code that is compiled is that of the package itself, as its sources are the same.
    """
    environment = os.environ | {"PYTHONPATH": str(folder)}
    if (compiled := cache_folder()) is not None:
        environment["NUMBA_CACHE_DIR"] = str(compiled.parent)
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, cwd=folder, capture_output=True,
        text=True, check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
