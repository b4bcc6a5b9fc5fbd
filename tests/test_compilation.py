"""Compiled code: cached by content, for this package alone, wherever a folder is writable."""

from __future__ import annotations

import ast
import errno
import gc
import os
import pickle
import random
import shutil
import subprocess
import sys
import tempfile
from hashlib import sha256
from pathlib import Path

import numba
import numpy as np
import pytest

from sweep import compilation
from sweep.cli.first_use import announce_compilation
from sweep.plan.experiment import Pipeline

TOP = Path(compilation.__file__).parent.parent
UNIT = "from sweep.model.supersampling import _unit; print(_unit(5), _unit.py_func(5))"
"""Compiles little: a function of one file that calls one of another."""


def run(script, top=TOP, **environment):
    variables = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    variables |= {"PYTHONPATH": str(top), **environment}
    variables = {name: value for name, value in variables.items() if value is not None}
    done = subprocess.run(
        [sys.executable, "-c", script], env=variables, capture_output=True, text=True, check=False,
        cwd="/",
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_functions_and_settings_of_the_caller_are_untouched(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import numba\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n"
    )
    before, after, value, folder = run(
        "import numba; before = numba.config.CACHE_DIR; import mine, sweep.model.supersampling as s"
        "; s._unit(1); print(repr(before), repr(numba.config.CACHE_DIR), mine.twice(3),"
        " mine.twice.stats.cache_path)",
        top=f"{TOP}{os.pathsep}{tmp_path}",
    )
    assert (before, after, value) == ("''", "''", "6")
    assert Path(folder) == tmp_path / "__pycache__"
    assert list(Path(folder).glob("mine.twice*.nbc"))


def test_folder_of_the_environment_is_used(tmp_path):
    run(UNIT, NUMBA_CACHE_DIR=str(tmp_path))
    (folder,) = tmp_path.iterdir()
    assert folder.name == f"compiled-{compilation.sources_digest()}"
    assert list(folder.glob("supersampling._unit*.nbc"))


@pytest.mark.long
def test_code_compiled_from_an_older_version_of_another_file_is_not_used(tmp_path):
    package, cached = tmp_path / "package", str(tmp_path / "cached")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(TOP / "sweep", package / "sweep", ignore=ignored)
    first, _ = run(UNIT, top=package, NUMBA_CACHE_DIR=cached)
    other = package / "sweep" / "model" / "splitmix.py"
    text = other.read_text()
    assert "np.uint64(31)" in text
    other.write_text(text.replace("np.uint64(31)", "np.uint64(29)"))
    second, interpreted = run(UNIT, top=package, NUMBA_CACHE_DIR=cached)
    assert second != first
    assert float(second) == float(interpreted)


@pytest.mark.long
def test_read_only_package_without_a_home_uses_a_private_temporary_folder(tmp_path):
    script = (
        "import os, pathlib\n"
        "def home(): raise RuntimeError('Could not determine home directory.')\n"
        "pathlib.Path.home = home\n"
        f"os.access = lambda path, mode: str(path).startswith({str(tmp_path)!r})\n"
    )
    first, _ = run(script + UNIT, TMPDIR=str(tmp_path), HOME=None)
    (folder,) = tmp_path.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert list(folder.glob("compiled-*/supersampling._unit*.nbc"))
    assert run(script + UNIT, TMPDIR=str(tmp_path), HOME=None)[0] == first
    # Others may have put something into a folder that they can write to: it is not loaded.
    folder.chmod(0o777)
    (path,) = run(script + "from sweep import compilation; print(compilation.cache_folder())",
                  TMPDIR=str(tmp_path), HOME=None)
    assert path == "None"
    assert run(script + UNIT, TMPDIR=str(tmp_path), HOME=None)[0] == first


def empty(path):
    path.write_bytes(b"")


def halve(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    content = bytearray(path.read_bytes())
    content[-len(content) // 3] ^= 1
    path.write_bytes(content)


def replace_by_folder(path):
    path.unlink()
    (path / "x").mkdir(parents=True)


def replace_by_another_object(path):
    content = pickle.dumps({"not": "code"})
    path.write_bytes(sha256(content).digest() + content)


def replace_by_numbas_own(path):
    path.write_bytes(pickle.dumps(numba.__version__) + pickle.dumps(("stamp", {})))


@pytest.fixture
def cached(monkeypatch, tmp_path):
    """A function that compiles anew with a cache in a folder: returns its value and cache hits."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()

    def call():
        function = compilation.compiled(_fraction)
        value = function(5)
        return value, sum(function.stats.cache_hits.values())

    return call


def _fraction(number):
    return (number * 7 % 11) / 11


DAMAGE = (empty, halve, flip, replace_by_folder, replace_by_another_object, replace_by_numbas_own)


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", ["*.nbi", "*.nbc", "*.nb?"])
def test_damaged_cache_costs_a_compilation_and_nothing_else(damage, kind, cached, tmp_path):
    assert cached() == (_fraction(5), 0)
    assert cached() == (_fraction(5), 1)
    files = [path for path in (tmp_path / "cache").glob(kind) if path.is_file()]
    assert files
    for path in files:
        damage(path)
    assert cached() == (_fraction(5), 0)
    assert cached() == (_fraction(5), 1)  # it was replaced


def test_flipped_byte_of_machine_code_is_never_executed(cached, tmp_path):
    cached()
    (path,) = (tmp_path / "cache").glob("*.nbc")
    sound = path.read_bytes()
    generator = random.Random(7)
    for _ in range(8):
        content = bytearray(sound)
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
        path.write_bytes(content)
        assert cached() == (_fraction(5), 0)


def test_cache_in_a_folder_without_space_is_replaced_by_a_private_one(
    cached, monkeypatch, tmp_path
):
    real = compilation._CacheFile._open_for_write

    def full(self, path):
        if str(path).startswith(str(tmp_path / "cache")):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(self, path)

    monkeypatch.setattr(compilation._CacheFile, "_open_for_write", full)
    assert cached() == (_fraction(5), 0)
    assert cached() == (_fraction(5), 1)
    (private,) = (tmp_path / "tmp").iterdir()
    assert private.stat().st_mode & 0o777 == 0o700
    # Nor is there space for that one: every process compiles.
    shutil.rmtree(private)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    assert cached() == (_fraction(5), 0)
    assert cached() == (_fraction(5), 0)


def test_what_compiled_code_uses_is_declared_in_the_sources_of_the_digest():
    sources = compilation.compiled_sources()
    modules = {
        ".".join(path.relative_to(TOP).with_suffix("").parts): ast.parse(path.read_text())
        for path in sources
    }
    for name, tree in modules.items():
        imported = {}
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sweep"):
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    origin = whole if whole in modules else node.module
                    imported[alias.asname or alias.name] = origin
        functions = [
            node for node in tree.body if isinstance(node, ast.FunctionDef)
            and any(
                isinstance(d, ast.Name) and d.id in ("compiled", "compiled_inline")
                for d in node.decorator_list
            )
        ]
        for function in functions:
            # Annotations are never evaluated; only what the body uses is compiled.
            for node in [part for statement in function.body for part in ast.walk(statement)]:
                if isinstance(node, ast.arg):
                    node.annotation = None
                elif isinstance(node, ast.FunctionDef):
                    node.returns = None
            used = {
                node.id for statement in function.body for node in ast.walk(statement)
                if isinstance(node, ast.Name)
            } - {argument.arg for argument in function.args.args}
            for origin in {imported[each] for each in used & imported.keys()}:
                assert origin in modules, f"{name}.{function.name} uses {origin}"


@compilation.compiled
def _added(values, step):
    return values[0] + step


@compilation.compiled
def _added_thrice(values, step):
    return _added(values, 1) + _added(values, 2) + _added(values, step)


def test_constants_of_callers_make_no_functions_of_their_own():
    enabled = gc.isenabled()
    for function in (_added, _added_thrice):  # an earlier run may have left them on disk
        function._cache.flush()
    assert _added_thrice(np.array([3.0]), 4) == 16.0
    assert len(_added.signatures) == 1  # each constant made one before: `fit` was compiled thrice
    assert gc.isenabled() == enabled


def test_compiled_functions_assign_no_arrays_to_slices():
    """That makes Numba compile the text of an error: 3 s in one function, and more in callers."""
    for path in compilation.compiled_sources()[:-1]:
        for function in ast.walk(ast.parse(path.read_text())):
            if not isinstance(function, ast.FunctionDef) or not any(
                isinstance(mark, ast.Name) and mark.id.startswith("compiled")
                for mark in function.decorator_list
            ):
                continue
            for node in ast.walk(function):
                if not isinstance(node, ast.Assign):
                    continue
                number = isinstance(node.value, (ast.Constant, ast.Call))
                for target in [] if number else node.targets:
                    sliced = isinstance(target, ast.Subscript) and any(
                        isinstance(part, ast.Slice) for part in ast.walk(target.slice)
                    )
                    assert not sliced, f"{path.name}:{node.lineno}"


def test_first_use_is_announced_and_no_later_one(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(compilation, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(compilation, "_substitute_folder", lambda: tmp_path / "none")
    plain = Pipeline.from_text("[pose]\nside_px = 50")
    bound = Pipeline.from_text(
        "[pose]\nside_px = 50\n[scene]\nnoise_grey = 2\nbound = 'known_blur'")
    for pipeline, compiled, line in (
        (plain, "", "compiling, once for this version: about 8 s\n"),
        (bound, "", "compiling, once for this version: about 18 s\n"),
        (bound, "coverage.accumulate-1", "compiling, once for this version: about 10 s\n"),
        (plain, "", ""),
        (bound, "likelihood.fit-1", ""),
    ):
        if compiled:
            (tmp_path / f"{compiled}.py311.nbi").touch()
        announce_compilation(pipeline)
        assert capsys.readouterr().err == line
