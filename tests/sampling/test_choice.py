"""A search for the smallest choice answers as the truth is, and faults of its file are lines."""

from types import SimpleNamespace

import numpy as np
import pytest

from support.searches import DOCUMENT, block_of, changed, flags_of, needed_by
from support.small_datasets import perfect
from sweep.analysis.requirements import Decision, ErrorShares, answers, choice_needed, choice_table
from sweep.errors import PipelineError
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.report import findings as size_lines
from sweep.sampling.rules import make_rule
from sweep.sampling.searches import choice_shares, group_dataset
from sweep.tradeoff import choice_search


def found_at(rates, trials, generator):
    """Return results of a group with detections at rates (size, tilt, dictionary)."""
    found = generator.random((3, 2, 2, trials)) < np.asarray(rates)[..., None]
    return flags_of(np.where(found, DetectionStatus.detected, DetectionStatus.rejected), 2)


@pytest.fixture
def chosen(monkeypatch):
    """Return what makes the choice of a search that found these rates (size, tilt)."""
    def choice(rates, trials, wish="smallest", sizes=(0.02, 0.04, 0.08)):
        pipeline = Pipeline.from_dict({
            "pose": {"distance_m": 1.0, "jitter_px": 0.5},
            "axes": {"size_m": list(sizes), "tilt_deg": [0, 60]},
            "require": {"all": ["detection >= 0.9"]},
            "search": {wish: "size_m", "max_trials": trials}})
        found = np.arange(trials) < np.round(trials * np.asarray(rates))[..., None]
        detection = np.where(found, DetectionStatus.detected, DetectionStatus.rejected)
        detection[np.isnan(rates)] = DetectionStatus.not_visible
        values = flags_of(detection)
        results = group_dataset(pipeline, block_of(values), values)
        monkeypatch.setattr(choice_search, "execute", lambda *_, **__: SimpleNamespace(
            store="runs/a.zarr", warnings=()))
        monkeypatch.setattr(choice_search, "open_dataset", lambda _: results)
        return choice_search.size(pipeline)

    return choice


@pytest.mark.parametrize(("wish", "rates", "bound"), [
    ("smallest", [[0.0, 0.0], [0.93, 1.0], [1.0, 1.0]], "at most size_m=0.08"),
    ("largest", [[1.0, 1.0], [0.93, 1.0], [0.0, 0.0]], "at least size_m=0.02"),
])
def test_an_answer_that_a_better_one_may_replace_is_not_decided(wish, rates, bound, chosen):
    choice = chosen(rates, 200, wish)
    shown = size_lines.as_json(choice)
    assert choice.decision is Decision.undecided
    assert shown["sentences"][0].startswith(f"not decided: {bound}")
    assert (shown["decision"], shown["answer"]) == (Decision.undecided, None)
    assert list(shown["known"]) == ["size_m"]


def test_trials_are_needed_up_to_the_first_size_that_fails():
    """Of sizes 0.02, 0.08, 0.04 the walk is 0.08, 0.04, 0.02; 4X4 fails at 0.04 and tilt 60.

    6X6 keeps everything; it is undecided everywhere after 50 trials (0.9 takes more than 100).
    """
    pipeline = Pipeline.from_dict(DOCUMENT)
    rule = make_rule(pipeline)
    rates = np.ones((3, 2, 2))
    rates[2, 1, 0] = 0.0
    needed = needed_by(rule, found_at(rates, 50, np.random.default_rng(1)))
    assert rule.coupled == ("size_m", "tilt_deg")
    assert needed[:, :, 1].all()
    assert needed[:, :, 0].tolist() == [[False, False], [True, True], [False, False]]
    rates = np.ones((3, 2, 2))
    assert not needed_by(rule, found_at(rates, 400, np.random.default_rng(1))).any()


def test_answers_name_the_next_size_and_what_it_fails_by():
    pipeline = Pipeline.from_dict(DOCUMENT)
    rates = np.ones((3, 2, 2))
    rates[0, 1, 1] = 0.3
    rates[1] = [[1.0, 1.0], [0.2, 1.0]]
    flags = found_at(rates, 400, np.random.default_rng(2))
    results = group_dataset(pipeline, block_of(flags), flags)
    found = answers(results, pipeline.stopping, choice_shares(pipeline, pipeline.stopping))
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


@pytest.mark.parametrize(("most", "hopeless"), [(2450, True), (2500, False)])
def test_what_too_few_poses_have_a_number_of_is_given_up(most, hopeless):
    # 1 of 50 poses is solved: 2,450 trials are worth 49 draws, one fewer than means need.
    results = perfect(np.random.default_rng(1), {"side_px": 2, "trial": 50})
    results["estimate"].values[:, 1:] = EstimateStatus.solver_failed
    rule = StoppingRule(kind="smallest", along="side_px", max_trials=most, unit=50,
                        requirements=("rotation_rmse_deg <= 5",))
    table = choice_table(results, rule, [ErrorShares(met=0.1, not_met=0.05)])
    assert table["hopeless"].all() == hopeless
    assert bool(choice_needed(table, rule).any()) != hopeless


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
