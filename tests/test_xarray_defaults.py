"""Arguments of xarray whose defaults change: they are given wherever arrays are put together."""

import ast
from pathlib import Path

import sweep

NEEDED = {"concat": {"coords", "compat", "join"}, "merge": {"compat", "join"},
          "combine_by_coords": {"coords", "compat", "join", "data_vars"}}


def test_every_call_that_combines_says_how():
    missing = []
    for path in sorted(Path(sweep.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            of = node.func.value
            if isinstance(of, ast.Name) and of.id in ("xr", "xarray"):
                lacking = NEEDED.get(node.func.attr, set()) - {each.arg for each in node.keywords}
                missing += [f"{path.name}:{node.lineno}: {sorted(lacking)}"] if lacking else []
    assert missing == []
