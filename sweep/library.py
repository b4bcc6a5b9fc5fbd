"""The modules of the library, each imported when it is first used (PEP 562).

Commands and the public functions reach the library through it, so that ``import sweep`` and
``sweep --help`` import neither OpenCV, Numba, Dask nor xarray.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sweep.analysis import camera_calibration, requirements
    from sweep.conformance import check
    from sweep.diagnosis import diagnosis, observations
    from sweep.evaluation import block, inspection, results
    from sweep.exchange import answers, export, score
    from sweep.execution import forecast, progress, runner, status
    from sweep.experiment import parameters, pipeline
    from sweep.integrity import verification
    from sweep.photographs import prepare
    from sweep.plugins import loading
    from sweep.report import figure, findings, output_file, report_data, scenes, table
    from sweep.sampling import rules
    from sweep.store import blocks, lifecycle, locations

if not TYPE_CHECKING:  # so that mypy knows the names above alone

    def __getattr__(name: str) -> Any:
        """Import a room's module when it is first used."""
        for path in Path(__file__).parent.glob(f"*/{name}.py"):
            return importlib.import_module(f"sweep.{path.parent.name}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
