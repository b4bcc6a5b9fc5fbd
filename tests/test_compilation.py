"""Compiled code: cached by Numba wherever a folder is writable, and never from other sources."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sweep import compilation
from sweep.errors import MachineFaultError
from sweep.execution.runner import announce_compilation
from sweep.experiment.pipeline import Pipeline

TOP = Path(compilation.__file__).parent.parent
UNIT = "from sweep.model.renderers import _unit; print(_unit(5), _unit.py_func(5))"
"""Compiles little: a function of one file that calls one of another."""


def run(script, top=TOP, **environment):
    variables = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    variables |= {"PYTHONPATH": str(top), **environment}
    done = subprocess.run(
        [sys.executable, "-c", script], env=variables, capture_output=True, text=True, check=False,
        cwd="/",
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.system
def test_code_compiled_from_an_older_version_of_another_file_is_not_used(tmp_path):
    package, cached = tmp_path / "package", str(tmp_path / "cached")
    ignored = shutil.ignore_patterns("__pycache__")  # never compiled
    shutil.copytree(TOP / "sweep", package / "sweep", ignore=ignored)
    first, _ = run(UNIT, top=package, NUMBA_CACHE_DIR=cached)
    assert list(Path(cached).glob("*/renderers._unit*.nbc"))
    other = package / "sweep" / "model" / "coverage.py"
    text = other.read_text()
    assert "np.uint64(31)" in text
    other.write_text(text.replace("np.uint64(31)", "np.uint64(29)"))
    second, interpreted = run(UNIT, top=package, NUMBA_CACHE_DIR=cached)
    assert second != first
    assert float(second) == float(interpreted)


FRACTION = """
from sweep.compilation import compiled

@compiled
def fraction(number):
    return (number * 7 % 11) / 11
"""


@pytest.mark.parametrize("kind", ["*.nbi", "*.nbc"])
def test_damaged_cache_is_the_fault_of_a_machine_and_names_the_folder(kind, monkeypatch, tmp_path):
    (tmp_path / "fractions_of_11.py").write_text(FRACTION)
    monkeypatch.syspath_prepend(tmp_path)

    def imported():
        sys.modules.pop("fractions_of_11", None)
        return __import__("fractions_of_11").fraction

    assert imported()(5) == 2 / 11
    loaded = imported()
    assert (loaded(5), sum(loaded.stats.cache_hits.values())) == (2 / 11, 1)
    (path,) = (tmp_path / "__pycache__").glob(kind)
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(MachineFaultError, match=r"delete its \.nbi and \.nbc files") as raised:
        imported()(5)
    assert str(tmp_path / "__pycache__") in str(raised.value)
    path.unlink()
    assert imported()(5) == 2 / 11


def test_what_compiled_code_uses_is_declared_in_the_sources_of_the_digest():
    modules = {
        ".".join(path.relative_to(TOP).with_suffix("").parts): ast.parse(path.read_text())
        for room in compilation.ROOMS for path in (TOP / "sweep" / room).glob("*.py")
    }
    for name, tree in modules.items():
        origins = {}  # name in this module -> the module that it comes from
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sweep"):
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    origins[alias.asname or alias.name] = (
                        whole if whole in modules else node.module)
        for function in tree.body:
            marks = [getattr(mark, "id", "") for mark in getattr(function, "decorator_list", ())]
            if {"compiled", "compiled_inline"} & {*marks}:
                used = {node.id for part in function.body for node in ast.walk(part)
                        if isinstance(node, ast.Name) and node.id in origins}
                used -= {argument.arg for argument in function.args.args}
                # Annotations inside are never evaluated.
                for origin in {origins[word] for word in used} - {"sweep.typing"}:
                    assert origin in modules, f"{name}.{function.name} uses {origin}"


def test_first_use_is_announced_and_no_later_one(monkeypatch, capsys):
    cached = set()
    monkeypatch.setattr(
        "sweep.execution.runner.is_cached", lambda module, name: f"{module}.{name}" in cached)
    plain = Pipeline.from_text("[pose]\nside_px = 50")
    bound = Pipeline.from_text(
        "[pose]\nside_px = 50\n[scene]\nnoise_grey = 2\nbound = 'known_blur'")
    for pipeline, compiled, seconds in (
        (plain, "", 3), (bound, "", 27), (bound, "sweep.model.coverage.draw_greys", 24),
        (plain, "", 0), (bound, "sweep.measure.likelihood.descend", 4),
    ):
        cached.add(compiled)
        announce_compilation(pipeline)
        line = f"compiling, once for this version: about {seconds} s\n" if seconds else ""
        assert capsys.readouterr().err == line
