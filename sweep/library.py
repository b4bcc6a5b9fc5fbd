"""The modules of the library, each imported when it is first used (PEP 562).

Commands and the public functions reach the library through it, so that ``import sweep`` and
``sweep --help`` import neither OpenCV, Numba, Dask nor xarray.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sweep import analysis as analysis
    from sweep import compilation as compilation
    from sweep import processor as processor
    from sweep.analysis import camera_calibration as camera_calibration
    from sweep.analysis import requirements as requirements
    from sweep.conformance import check as check
    from sweep.diagnosis import detection as detection
    from sweep.diagnosis import diagnosis as diagnosis
    from sweep.diagnosis import observations as observations
    from sweep.evaluation import block as block
    from sweep.evaluation import inspection as inspection
    from sweep.exchange import answers as answers
    from sweep.exchange import export as export
    from sweep.exchange import score as score
    from sweep.execution import forecast as forecast
    from sweep.execution import limit_search as limit_search
    from sweep.execution import progress as progress
    from sweep.execution import runner as runner
    from sweep.execution import status as status
    from sweep.experiment import cell_selection as cell_selection
    from sweep.experiment import parameters as parameters
    from sweep.experiment import pipeline as pipeline
    from sweep.experiment import sampling as sampling
    from sweep.fitting import folders as folders
    from sweep.integrity import repair as repair
    from sweep.integrity import reproduction as reproduction
    from sweep.integrity import verification as verification
    from sweep.photographs import folder as folder
    from sweep.photographs import prepare as prepare
    from sweep.photographs import twins as twins
    from sweep.plugins import declared as declared
    from sweep.report import comparison_tables as comparison_tables
    from sweep.report import decisions as decisions
    from sweep.report import error_model_file as error_model_file
    from sweep.report import figure as figure
    from sweep.report import limit_figure as limit_figure
    from sweep.report import output_file as output_file
    from sweep.report import questions as questions
    from sweep.report import reference as reference
    from sweep.report import report_data as report_data
    from sweep.report import scenes as scenes
    from sweep.report import table as table
    from sweep.sampling import rules as rules
    from sweep.store import lifecycle as lifecycle
    from sweep.store import locations as locations
    from sweep.store import lock as lock
    from sweep.tradeoff import choice_search as choice_search

_MODULES = (
    "sweep.analysis",
    "sweep.analysis.camera_calibration",
    "sweep.analysis.requirements",
    "sweep.compilation",
    "sweep.conformance.check",
    "sweep.diagnosis.detection",
    "sweep.diagnosis.diagnosis",
    "sweep.diagnosis.observations",
    "sweep.evaluation.block",
    "sweep.evaluation.inspection",
    "sweep.exchange.answers",
    "sweep.exchange.export",
    "sweep.exchange.score",
    "sweep.execution.forecast",
    "sweep.execution.limit_search",
    "sweep.execution.progress",
    "sweep.execution.runner",
    "sweep.execution.status",
    "sweep.fitting.folders",
    "sweep.integrity.repair",
    "sweep.integrity.reproduction",
    "sweep.integrity.verification",
    "sweep.photographs.folder",
    "sweep.photographs.prepare",
    "sweep.photographs.twins",
    "sweep.experiment.cell_selection",
    "sweep.experiment.parameters",
    "sweep.experiment.pipeline",
    "sweep.experiment.sampling",
    "sweep.plugins.declared",
    "sweep.processor",
    "sweep.report.comparison_tables",
    "sweep.report.decisions",
    "sweep.report.figure",
    "sweep.report.error_model_file",
    "sweep.report.limit_figure",
    "sweep.report.output_file",
    "sweep.report.questions",
    "sweep.report.reference",
    "sweep.report.report_data",
    "sweep.report.scenes",
    "sweep.report.table",
    "sweep.sampling.rules",
    "sweep.store.lifecycle",
    "sweep.store.locations",
    "sweep.store.lock",
    "sweep.tradeoff.choice_search",
)


if not TYPE_CHECKING:  # so that mypy knows the names above alone

    def __getattr__(name: str) -> ModuleType:
        """Import a module when it is first used."""
        for module in _MODULES:
            if module.rpartition(".")[2] == name:
                return importlib.import_module(module)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
