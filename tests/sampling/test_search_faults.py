"""Faults of the sections [require] and [search] are told in lines, all at once."""

import pytest

from support.searches import changed
from sweep.errors import PipelineError
from sweep.experiment.pipeline import Pipeline
from sweep.sampling.rules import make_rule

LIMIT = {"smallest": None, "among": None, "along": "size_m"}
PRECISION = {"smallest": None, "among": None, "precision": {"detection_rate": 0.1}}


def faults_of(**change):
    with pytest.raises(PipelineError) as caught:
        make_rule(Pipeline.from_dict(changed(**change)))
    return caught.value.faults


@pytest.mark.parametrize(("change", "line"), [
    ({"search": {"smallest": "dictionary", "among": []}}, "expected an axis of several numbers"),
    ({"search": {"smallest": "size"}}, "size: no such axis; did you mean size_m?"),
    ({"search": {"max_trials": 30}}, "search.max_trials = 30: expected at least "),
    ({"search": {"smallest": "distance_m"}, "pose": {"distance_m": {"uniform": [1, 2]}}},
     "distance_m: no such axis; expected one under [axes] of the scene: "),
    ({"require": None}, 'expected what must be met: [require] all = ["detection >= 0.99"]'),
    ({"require": {"per": ["size_m"]}}, "expected conditions; size_m is what [search] chooses"),
    ({"require": {"all": ["budget_ms <= 2"]}, "search": None}, "is the time of a choice"),
    ({"sampling": "sobol"}, "expected independent beside [search]"),
    ({"search": LIMIT | {"per": ["nothing"]}}, "no such axis"),
    ({"search": PRECISION | {"precision": {"detection_rate": 0.1, "detection": 0.2}}},
     "another half-width"),
])
def test_a_search_that_cannot_be_made_is_a_line(change, line):
    faults = faults_of(**change)
    assert any(line in fault for fault in faults), faults
    assert len(faults) == 1 or "axes" in change or "require" in change, faults


def test_all_faults_come_at_once():
    assert len(faults_of(search={"smallest": "solver", "per": ["size_m"], "other": 1})) == 3
    unknown = dict.fromkeys(("detection_rte", "rotation_rmse_rad", "flips"), 0.1)
    lines = faults_of(search=PRECISION | {"precision": unknown})
    assert len(lines) == 3
    assert "nothing of this name has an interval; did you mean detection_rate?" in lines[0]
