"""The flags: values that stores hold, and what is derived from the members."""

from __future__ import annotations

import pickle

import pytest

from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped

STORED = {
    DetectionStatus: "not_run detected wrong_id rejected no_candidate not_visible not_modelled "
    "failed crashed",
    EstimateStatus: "not_run solved no_detection solver_failed failed crashed not_converged "
    "not_explained",
    BoundStatus: "not_run given no_noise no_contrast clipped not_in_model not_visible",
    Flipped: "not_run not_flipped flipped no_estimate",
}
"""What stores of 0.5.0 hold, from 0 on."""


@pytest.mark.parametrize("kind", STORED)
def test_values_are_those_of_existing_stores_and_survive_pickling(kind):
    names = STORED[kind].split()
    assert [kind(value).name for value in range(len(names))] == names
    assert all(pickle.loads(pickle.dumps(member)) is member for member in kind)  # noqa: S301
