"""What a run says of failures, of nothing detected, and of its rate."""


import numpy as np
import pytest

from sweep.execution.status import WrittenBlock, poses_per_second
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.store.outcome import FailedCell, failure_groups, outcome_of

TRACEBACK = """Traceback (most recent call last):
  File "a.py", line 3, in f
    raise ValueError("x")
    ^^^^^^^^^^^^^^^^^^^^^
{}
"""


def outcome(detection, estimate, cells):
    counts = [[given.get(flag.name, 0) for flag in flags]
              for flags, given in ((DetectionStatus, detection), (EstimateStatus, estimate))]
    return outcome_of("a b.zarr", *counts, cells, "trial=0")


def failed(message, at, kind="failed", stage="estimation"):
    return FailedCell(at, kind, stage, TRACEBACK.format(message))


def test_failures_are_grouped_by_exception_without_its_numbers_and_by_stage():
    cells = [
        failed(f"ValueError: pose {n} at 0x7f{n:04x}: {n / 7} px\n  more lines: {n}", f"trial={n}")
        for n in range(9)
    ]
    cells += [failed("ValueError: other", "trial=20"), failed("KeyError: 'a'", "trial=21")]
    cells += [failed("ValueError: other", "trial=22", stage="detection")]
    cells += [FailedCell("trial=23", "crashed", "scene", "ended by SIGSEGV")]
    found = [(group.count, group.kind, group.stage, group.reason, group.at)
             for group in failure_groups(cells)]
    assert found == [
        (9, "failed", "estimation", "ValueError: pose 0 at 0x7f0000: 0.0 px", "trial=0"),
        (1, "failed", "estimation", "ValueError: other", "trial=20"),
        (1, "failed", "estimation", "KeyError: 'a'", "trial=21"),
        (1, "failed", "detection", "ValueError: other", "trial=22"),
        (1, "crashed", "scene", "ended by SIGSEGV", "trial=23"),
    ]


@pytest.mark.parametrize(
    ("detection", "estimate", "nothing", "share", "first"),
    [
        ({"detected": 40}, {"failed": 40}, True, 1.0, "nothing computed: all 40 estimates failed"),
        ({"failed": 30, "crashed": 10}, {"no_detection": 40}, True, 1.0,
         "nothing computed: all 40 detections failed or crashed"),
        ({"detected": 80, "crashed": 20}, {"solved": 80, "no_detection": 20}, False, 0.2,
         "warning: 20 crashed of 100 detections (20 %)"),
        ({"detected": 990, "failed": 10}, {"solved": 990, "no_detection": 10}, False, 0.01,
         "10 failed of 1,000 detections (1 %)"),
        ({"not_visible": 7}, {"no_detection": 7}, False, 0.0,
         "warning: nothing was detected: 7 not_visible (The marker is wholly outside"),
        ({"detected": 7}, {"solver_failed": 7}, False, 0.0,
         "warning: no pose was estimated: 7 solver_failed (The solver returned no solution"),
        ({"detected": 7}, {"solved": 7}, False, 0.0, None),
        ({"detected": 7}, {"not_explained": 7}, False, 0.0, None),
    ],
)
def test_what_failed_is_said_first_and_loudest(detection, estimate, nothing, share, first):
    cells = [failed("E: 1", "trial=3")] if share else []
    found = outcome(detection, estimate, cells)
    assert (found.nothing_computed, found.failed_share) == (nothing, pytest.approx(share))
    if first is None:
        assert (found.warnings, found.advice) == ([], "")
        return
    assert found.warnings[0].startswith(first)
    expected = "--at trial=3" if share else "--at trial=0 -o scene.png"
    assert found.advice == f"sweep repro 'a b.zarr' {expected}"


def blocks(workers, count, *, begin, took=2.0, scenes=100, lockstep=True):
    """Return blocks of workers that are always busy, from ``begin`` on."""
    shift = 0.0 if lockstep else took / workers
    return [
        WrittenBlock(begin + took * (n // workers + 1) + shift * (n % workers), took, scenes)
        for n in range(count)
    ]


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize(("workers", "count"), [(1, 8), (2, 20), (1000, 9000)])
def test_rate_is_within_a_fifth_of_the_true_one_also_after_a_faster_run(workers, count, lockstep):
    run = blocks(workers, count, begin=5000.0, lockstep=lockstep)
    before = blocks(workers, count, begin=0.0, took=0.5, lockstep=lockstep)
    np.random.default_rng(0).shuffle(run)
    for written in (run, [*before, *run]):
        assert poses_per_second(written) == pytest.approx(workers * 100 / 2.0, rel=0.2)
