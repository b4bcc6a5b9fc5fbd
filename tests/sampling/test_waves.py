"""Waves: where they end, which blocks they have, and that results do not depend on the blocks."""

import itertools
import math

import numpy as np
import pytest

from sweep.experiment.grid import Blocks
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import wave_ends
from sweep.sampling.rules import Waves, make_rule

TEXT = """
seed = 3
camera = { width_px = 64, height_px = 48 }
pose = { jitter_px = 0.5 }
scene = { renderer = "warp" }
axes = { tilt_deg = [0, 60], side_px = [8, 13, 30] }
search = { precision = { detection_rate = 0.1 }, max_trials = 100, per = ["side_px"] }
"""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="waves")


@pytest.mark.parametrize(("most", "unit"), [
    (1, 7), (49, 50), (50, 50), (51, 7), (2400, 50), (100_000, 1)])
def test_waves_end_at_multiples_of_their_unit_and_grow_by_a_quarter(most, unit):
    ends = wave_ends(most, unit)
    assert ends[-1] == most
    assert ends == tuple(sorted(set(ends)))
    assert all(end % unit == 0 for end in ends[:-1])
    steps = np.diff((0, *ends[:-1]))
    assert all(step <= max(unit, end / 4 + unit) for end, step in zip((0, *ends), steps,
                                                                      strict=False))
    assert len(ends) <= 12 + 4 * math.log(most / unit) if most > unit else len(ends) == 1
    assert all(end % ends[0] == 0 for end in ends[:-1])


@pytest.mark.parametrize("extents", [(1, 1, 25), (2, 1, 5), (1, 2, 25), (2, 3, 1)])
def test_each_block_is_in_one_wave_of_one_group(extents, pipeline):
    rule = make_rule(pipeline)
    blocks = Blocks((2, 3, 100), extents)
    waves = Waves.of(pipeline, rule, blocks)
    found = [
        (number, group, wave)
        for group, wave in itertools.product(range(len(waves.groups)), range(len(rule.ends)))
        for number in waves.numbers(group, wave)
    ]
    assert sorted(number for number, _, _ in found) == list(range(len(blocks)))
    for number, group, wave in found:
        block = blocks[number]
        assert waves.groups.number(block) == group
        assert (0, *rule.ends)[wave] <= block.starts[2] < block.stops[2] <= rule.ends[wave]
        assert group == block.starts[1] // extents[1]  # tilt_deg is pooled
