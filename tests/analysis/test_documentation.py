"""The public functions' docstrings: numpydoc's sections, types, and examples that run."""

import doctest
import importlib
import inspect
import pkgutil
from pathlib import Path

import pytest
import xarray as xr

import sweep.analysis
from support.example_results import example_results

FUNCTIONS = [getattr(sweep.analysis, name) for name in sweep.analysis.__all__]
GUIDE = (Path(sweep.analysis.__file__).parent / "README.md").read_text(encoding="utf-8")
MODULES = [importlib.import_module(f"sweep.analysis.{module.name}")
           for module in pkgutil.iter_modules(sweep.analysis.__path__)]


@pytest.mark.parametrize("function", FUNCTIONS, ids=sweep.analysis.__all__)
def test_a_public_function_has_the_sections_of_numpydoc_and_is_in_the_guide(function):
    assert f"`{function.__name__}`" in GUIDE
    lines = [line.strip() for line in function.__doc__.splitlines()]
    for section in ("Parameters", "Returns", "Raises", "Notes", "Examples"):
        assert lines[lines.index(section) + 1] == "-" * len(section), section
    parameters = lines[lines.index("Parameters"):lines.index("Returns")]
    for name in inspect.signature(function).parameters:
        assert any(name in line.split(", ") for line in parameters), name


@pytest.mark.parametrize("module", MODULES, ids=[module.__name__ for module in MODULES])
def test_examples_run(module):
    runner = doctest.DocTestRunner()
    for example in doctest.DocTestFinder().find(
            module, extraglobs={"results": example_results(), "xr": xr}):
        runner.run(example)
    assert runner.failures == 0
    examples = [f for f in FUNCTIONS if f.__module__ == module.__name__]
    assert runner.tries >= 2 * len(examples)
