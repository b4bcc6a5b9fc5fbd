"""Which settings a configuration uses, where an axis holds those of several detectors."""

from __future__ import annotations

import itertools

import pytest

from sweep.experiment.experiment import distinct, used_settings
from sweep.experiment.pipeline import Pipeline

PLUGINS = """
from dataclasses import dataclass
from sweep.plugins import DetectorPlugin, EstimatorPlugin, parameter

@dataclass(frozen=True)
class Fine:
    steps: int = parameter(2, "steps", low=1)

A = DetectorPlugin(make=lambda settings, family: lambda image: ([], []), settings=Fine)
B = DetectorPlugin(make=lambda settings, family: lambda image: ([], []))
S = EstimatorPlugin(make=lambda settings: lambda detections: None)
"""

TEXT = """
[pose]
side_px = 40
[axes]
cornerRefinementMethod = ["none", "subpix"]
steps = [2, 3]
detector = ["opencv", "own.py:A", "own.py:B"]
solver = ["ippe", "own.py:S"]
guarded = [true, false]
"""


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    folder = tmp_path_factory.mktemp("settings")
    (folder / "own.py").write_text(PLUGINS)
    return lambda text: Pipeline.from_text(text, folder=folder)


def combinations(pipeline):
    return [dict(zip([axis.name for axis in pipeline.axes], chosen, strict=True))
            for chosen in itertools.product(*(axis.values for axis in pipeline.axes))]


def test_each_detector_and_solver_is_told_apart_by_its_own_settings_alone(pipeline):
    made = pipeline(TEXT)
    every = combinations(made)
    texts = [" ".join(map(str, used_settings(made, every[k]).values()))
             for k in distinct(made, every)]
    detectors = ["none opencv", "subpix opencv", "2 own.py:A", "3 own.py:A", "own.py:B"]
    solvers = ["ippe True", "ippe False", "own.py:S"]
    assert sorted(texts) == sorted(map(" ".join, itertools.product(detectors, solvers)))


def test_settings_of_a_fixed_detector_and_those_that_go_together(pipeline):
    fixed = pipeline('[pose]\nside_px = 40\n[detector]\ndetector = "own.py:B"\n[axes]\n'
                     "adaptiveThreshConstant = [5, 7]\n")
    assert used_settings(fixed, {"adaptiveThreshConstant": 5}) == {}
    assert distinct(fixed, combinations(fixed)) == [0]
    together = pipeline(
        '[pose]\nside_px = 40\n[axes]\npair = { zip = { detector = ["opencv", "own.py:A"], '
        "steps = [2, 3] } }\n")
    assert len(distinct(together, combinations(together))) == 2
