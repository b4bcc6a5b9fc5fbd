"""A search for the smallest choice answers as the truth is, and faults of its file are lines."""

import numpy as np
import pytest
import xarray as xr

import sweep
from sweep.analysis.choices import answers
from sweep.analysis.requirements import Decision
from sweep.errors import PipelineError
from sweep.execution.runner import execute
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.experiment import Pipeline
from sweep.sampling.choice import store_cells
from sweep.sampling.group_dataset import group_dataset
from sweep.sampling.rules import make_rule
from sweep.sampling.stopping import GroupResults

DOCUMENT = {
    "pose": {"distance_m": 1.0, "jitter_px": 0.5},
    "axes": {"size_m": [0.02, 0.08, 0.04], "tilt_deg": [0, 60],
             "dictionary": ["DICT_4X4_50", "DICT_6X6_50"], "solver": ["ippe", "iterative"]},
    "require": {"all": ["detection >= 0.9"]},
    "choose": {"smallest": "size_m", "among": ["dictionary"], "max_trials": 400},
}


def changed(**sections):
    """Return the document with keys of sections replaced; None takes one away."""
    document = {name: dict(table) for name, table in DOCUMENT.items()}
    for section, keys in sections.items():
        for key, value in (keys or {}).items():
            document.setdefault(section, {})[key] = value
            if value is None:
                del document[section][key]
        if keys is None:
            del document[section]
    return document


FAULTS = [
    ({"choose": {"smallest": "solver"}}, 'choose.smallest = "solver": expected an axis of the sc'),
    ({"choose": {"smallest": "dictionary", "among": []}}, "dictionary has no order: put it into"),
    ({"choose": {"smallest": "distance_m"}}, "list the values of distance_m under [axes]"),
    ({"choose": {"smallest": "trial"}}, "trials are what is counted"),
    ({"choose": {"smallest": "size"}}, "size: no such axis; did you mean size_m?"),
    ({"choose": {"largest": "size_m"}}, "smallest or largest, not both"),
    ({"choose": {"among": ["size_m"]}}, "size_m once: it is sought along already"),
    ({"choose": {"among": "dictionary"}}, 'a list of names of axes, such as ["dictionary", "solv'),
    ({"choose": {"confidence": 95}}, "choose.confidence = 95: expected a number from 0.5 to"),
    ({"choose": {"max_trials": 0}}, "choose.max_trials = 0: expected"),
    ({"choose": {"max_trials": 30}}, "choose.max_trials = 30: expected at least "),
    ({"choose": {"smalest": 1}}, "choose.smalest: unknown key; expected smallest, largest"),
    ({"axes": {"size_m": [0.02]}}, "size_m has one: there is nothing to choose"),
    ({"choose": {"smallest": "distance_m"}, "pose": {"distance_m": {"uniform": [1, 2]}}},
     "distance_m is drawn: give it values under [axes]"),
    ({"require": None}, 'expected what must be met: [require] all = ["detection >= 0.99"]'),
    ({"require": {"per": ["size_m"]}}, "expected conditions; size_m is what [choose] chooses"),
    ({"require": {"all": ["detection >= 0.9", "detection <= 0.8"]}}, "contradicts"),
    ({"require": {"all": ["budget_ms <= 2"]}}, "expected what must be met"),
    ({"require": {"all": ["detection >= 0.9", "budget_ms >= 2"]}}, "milliseconds of a frame: budg"),
    ({"require": {"all": ["detection >= 0.9", "budget_ms <= 2", "budget_ms <= 1"]}},
     "there is another budget; delete one"),
    ({"choose": {"smallest": None, "among": []}, "axes": {"solver": ["ippe"]}},
     "something to choose: smallest = "),
]


@pytest.mark.parametrize(("change", "line"), FAULTS)
def test_a_choice_that_cannot_be_made_is_a_line(change, line):
    with pytest.raises(PipelineError) as caught:
        make_rule(Pipeline.from_dict(changed(**change)))
    assert any(line in fault for fault in caught.value.faults), caught.value.faults


def test_sobol_points_are_refused_in_one_line_that_names_no_other_number_of_trials():
    with pytest.raises(PipelineError) as caught:
        Pipeline.from_dict({**DOCUMENT, "sampling": "sobol"})
    line, = caught.value.faults
    assert "expected independent beside [choose]" in line


def test_values_that_are_no_axis_are_one_fault():
    with pytest.raises(PipelineError) as caught:
        Pipeline.from_dict(changed(axes={"size_m": [0.08, 0.08]}))
    line, = caught.value.faults
    assert "expected each value once" in line


@pytest.mark.parametrize("section", [
    {"choose": DOCUMENT["choose"], "require": DOCUMENT["require"]},
    {"precision": {"detection_rate": 0.1}},
    {"limit": {"along": "size_m", "require": ["detection >= 0.9"]}},
])
def test_axes_that_are_no_table_are_a_fault_beside_every_rule(section):
    with pytest.raises(PipelineError, match=r"axes = 3: expected a table: \[axes\]"):
        Pipeline.from_dict({**section, "axes": 3})


def test_a_budget_needs_a_choice():
    with pytest.raises(PipelineError, match="is the time of a choice"):
        Pipeline.from_dict(changed(choose=None, require={"all": ["budget_ms <= 2"]}))


def test_all_faults_come_at_once():
    with pytest.raises(PipelineError) as caught:
        Pipeline.from_dict(changed(choose={"smallest": "solver", "confidence": 2, "other": 1}))
    assert len(caught.value.faults) == 3


def group(pipeline, rates, trials, generator):
    """Return results of a group with detections at rates (size, tilt, dictionary)."""
    shape = (3, 2, 2, trials)
    found = generator.random(shape) < np.asarray(rates)[..., None]
    detection = np.where(found, DetectionStatus.detected, DetectionStatus.rejected)
    both = np.broadcast_to(found[..., None], (*shape, 2))
    return GroupResults(pipeline, (0, 0, 0), (3, 2, 2), 1, trials, {
        "detection": detection.astype(np.uint8),
        "estimate": np.where(
            both, EstimateStatus.solved, EstimateStatus.no_detection).astype(np.uint8),
        "flipped": np.where(both, Flipped.not_flipped, Flipped.no_estimate).astype(np.uint8)})


def test_trials_are_needed_up_to_the_first_size_that_fails():
    """Of sizes 0.02, 0.08, 0.04 the walk is 0.08, 0.04, 0.02; 4X4 fails at 0.04 and tilt 60.

    6X6 keeps everything; it is undecided everywhere after 50 trials (0.9 takes more than 100).
    """
    pipeline = Pipeline.from_dict(DOCUMENT)
    rule = make_rule(pipeline)
    rates = np.ones((3, 2, 2))
    rates[2, 1, 0] = 0.0
    needed = rule.needed(group(pipeline, rates, 50, np.random.default_rng(1)))
    assert rule.coupled == ("size_m", "tilt_deg")
    assert needed[:, :, 1].all()
    assert needed[:, :, 0].tolist() == [[False, False], [True, True], [False, False]]
    rates = np.ones((3, 2, 2))
    assert not rule.needed(group(pipeline, rates, 400, np.random.default_rng(1))).any()


def test_pipelines_are_read_again_from_their_text():
    pipeline = Pipeline.from_dict(changed(require={"all": ["detection >= 0.9", "budget_ms <= 2"]}))
    again = Pipeline.from_text(pipeline.to_toml())
    assert again.stopping == pipeline.stopping
    assert (again.budget_ms, again.requirements) == (2.0, ("detection >= 0.9",))
    assert pipeline.stopping.per == ("tilt_deg",)
    assert pipeline.stopping.among == ("dictionary", "solver")


def test_another_choice_does_not_continue_a_store():
    rule = Pipeline.from_dict(DOCUMENT).stopping
    other = Pipeline.from_dict(changed(choose={"max_trials": 500})).stopping
    assert other.looser(rule) == "choose: max_trials: the store has 400, this run 500"
    assert not rule.looser(rule)


@pytest.mark.long
def test_a_search_is_the_same_with_one_or_two_workers_and_other_blocks(tmp_path):
    """The stores of a search are equal value for value, and cost less than the whole grid."""
    document = changed(axes={"size_m": [0.01, 0.02, 0.03, 0.06]}, choose={"max_trials": 200})
    stores = []
    for number, options in enumerate((
            {"workers": 1}, {"workers": 2}, {"workers": 1, "block_s": 0.01})):
        stores.append(tmp_path / f"{number}.zarr")
        execute(Pipeline.from_dict(document), str(stores[-1]), **options)
    first, *others = map(sweep.open, stores)
    for other in others:
        xr.testing.assert_identical(
            first.load().drop_attrs(), other.load().drop_attrs())
    needed = (first["detection"] != DetectionStatus.not_needed).mean()
    assert 0.2 < float(needed) < 0.8


def test_answers_name_the_next_size_and_what_it_fails_by():
    pipeline = Pipeline.from_dict(DOCUMENT)
    rates = np.ones((3, 2, 2))
    rates[0, 1, 1] = 0.3
    rates[1] = [[1.0, 1.0], [0.2, 1.0]]
    results = group_dataset(group(pipeline, rates, 400, np.random.default_rng(2)))
    found = answers(store_cells(results, pipeline, pipeline.stopping), "size_m")
    by = {tuple(each.alternative.values()): each for each in found}
    assert list(by) == [(dictionary, solver) for dictionary in ("DICT_4X4_50", "DICT_6X6_50")
                        for solver in ("ippe", "iterative")]
    none, some = by["DICT_4X4_50", "ippe"], by["DICT_6X6_50", "iterative"]
    assert (none.met, none.value, none.next, none.passing) == (False, None, 0.08, (0.04, 0.02))
    assert none.nearest.value in (0.04, 0.02)
    assert (some.met, some.value, some.next) == (True, 0.04, 0.02)
    assert some.next_cause.decision is Decision.not_met
    assert some.next_cause.condition == {"tilt_deg": 60.0}
    assert some.next_cause.value == pytest.approx(0.3, abs=0.15)
    assert some.next_cause.draws == 400
