"""Change constants, signs and comparisons one at a time; name the changes that no test notices.

``python tests/mutants.py COUNT [SEED] [ROOM ...]`` copies the repository, changes one place of
the copy, and runs tests: first those of the room that import the changed module, the nearest first,
then the room's others and those of rooms above it. It prints a line a mutant: killed, lives,
"fails unchanged" where these tests do not pass on the unchanged copy, or "out of time" where they
were ended before one failed; the last two decide nothing. Then it prints the number of each.
"""

from __future__ import annotations

import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

TOP = Path(__file__).parents[1]
ROOMS = {
    "model": ("measure", "evaluation", "experiment"), "measure": ("evaluation", "exchange"),
    "analysis": ("sampling", "report"),
}
"""Room -> rooms above it, whose tests use it."""

FILES_A_MUTANT = 6
LIMIT_S = 1200.0
"""For one run of tests: a change of a compiled room compiles all of it anew."""

COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
SIGNS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


def mutated(node: ast.AST) -> ast.expr | None:
    """Return what takes an expression's place, None where nothing does."""
    match node:
        case ast.Compare(left, [operator], rights) if type(operator) in COMPARISONS:
            return ast.Compare(left, [COMPARISONS[type(operator)]()], rights)
        case ast.BinOp(left, operator, right) if type(operator) in SIGNS:
            if any(isinstance(part, ast.JoinedStr) for part in (left, right)):
                return None
            return ast.BinOp(left, SIGNS[type(operator)](), right)
        case ast.Constant(value) if type(value) is int:
            return ast.Constant(value + 1)
        case ast.Constant(value) if type(value) is float:
            return ast.Constant(value * 1.5 + 0.01 * (value == 0))
        case ast.UnaryOp(ast.USub(), operand) if not isinstance(operand, ast.Constant):
            return operand
    return None


def places(source: str) -> list[tuple[ast.expr, ast.expr]]:
    """Return the expressions inside functions that can be mutated, each with its mutant."""
    functions = [
        node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef | ast.ClassDef)
    ]
    found = {
        (node.lineno, node.col_offset, node.end_lineno, node.end_col_offset): (node, changed)
        for function in functions for statement in function.body for node in ast.walk(statement)
        if isinstance(node, ast.expr) and (changed := mutated(node)) is not None
    }
    return [found[key] for key in sorted(found)]


def replaced(source: str, old: ast.expr, new: ast.expr) -> str:
    """Return a source in which one expression is another."""
    lines = source.encode().splitlines(keepends=True)
    first, last = old.lineno - 1, (old.end_lineno or old.lineno) - 1
    head = b"".join(lines[:first]) + lines[first][: old.col_offset]
    tail = lines[last][old.end_col_offset:] + b"".join(lines[last + 1:])
    return (head + f"({ast.unparse(new)})".encode() + tail).decode()


def tests_of(module: str, room: str) -> list[str]:
    """Return the test files of a room that import a module, the shortest first."""
    name = module.rpartition(".")[2]
    wanted = (f"from {module} import", f"import {module}", f"from sweep.{room} import {name}")
    files = sorted((TOP / "tests" / room).glob("test_*.py"), key=lambda file: file.stat().st_size)
    direct = [file for file in files if any(text in file.read_text() for text in wanted)]
    others = [file for file in files if file not in direct]
    return [str(file.relative_to(TOP)) for file in (direct + others)[:FILES_A_MUTANT]]


def verdict(copy: Path, tests: list[str]) -> str:
    """Run tests in a copy of the repository; return what became of its mutant."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests],
            cwd=copy, env=environment, capture_output=True, check=False, timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return "out of time"
    return "lives" if done.returncode == 0 else "killed"


def main(count: int, seed: int = 38, *rooms: str) -> None:
    """Try mutants, and print what became of each."""
    draw = random.Random(seed)
    folders = [TOP / "sweep" / room for room in rooms or ROOMS]
    files = [file for folder in folders for file in sorted(folder.glob("*.py"))]
    choices = [
        (file, *place) for file in files for place in places(file.read_text(encoding="utf-8"))
    ]
    results: list[str] = []
    sound: dict[tuple[str, ...], bool] = {}
    print(f"{count} of {len(choices)} places, seed {seed}")
    print("| place | from | to | verdict |\n| --- | --- | --- | --- |", flush=True)
    with tempfile.TemporaryDirectory() as work:
        copy = Path(work) / "copy"
        ignored = shutil.ignore_patterns(".git", ".venv", "runs", ".mypy_cache", ".ruff_cache")
        shutil.copytree(TOP, copy, ignore=ignored)  # with its compiled code
        for file, old, new in draw.sample(choices, count):
            name = file.relative_to(TOP)
            source, room = file.read_text(encoding="utf-8"), name.parts[1]
            near = tests_of(".".join(name.with_suffix("").parts), room)
            for tests in (near, [f"tests/{each}" for each in (room, *ROOMS[room])]):
                if tuple(tests) not in sound:
                    sound[tuple(tests)] = verdict(copy, tests) == "lives"
                (copy / name).write_text(replaced(source, old, new), encoding="utf-8")
                result = verdict(copy, tests) if sound[tuple(tests)] else "fails unchanged"
                (copy / name).write_text(source, encoding="utf-8")
                if result != "lives":
                    break
            results.append(result)
            before, after = (" ".join(ast.unparse(part).split())[:50] for part in (old, new))
            print(f"| {name}:{old.lineno} | `{before}` | `{after}` | {result} |", flush=True)
    for result in sorted(set(results)):
        print(f"{result}: {results.count(result)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
