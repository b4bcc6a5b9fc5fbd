"""The rule that samples, by what the pipeline says."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import cast

from sweep.plan.choice_rule import ChoiceRule
from sweep.plan.experiment import Pipeline
from sweep.plan.limit_rule import LimitRule
from sweep.plan.precision_rule import PrecisionRule
from sweep.sampling.stopping import Stopping

RULES: Mapping[type, str] = {
    ChoiceRule: "sweep.sampling.choice:choice_sampling",
    LimitRule: "sweep.sampling.limit:limit_sampling",
    PrecisionRule: "sweep.sampling.precision:precision_sampling",
}
"""Class of what a section says -> module and function that make its rule, of a pipeline and that.

The sections are in `sweep.plan.stopping.SECTIONS`. The function raises PipelineError with a line
for each name that it does not know. Its module is imported on use: runs of fixed trials need none.
"""


def make_rule(pipeline: Pipeline) -> Stopping | None:
    """Return the rule by which a pipeline's sampling stops; None if every trial is computed.

    Raises
    ------
    PipelineError
        One line for each fault of the section that only the rule knows.
    """
    if pipeline.stopping is None:
        return None
    module, _, name = RULES[type(pipeline.stopping)].partition(":")
    make = getattr(importlib.import_module(module), name)
    return cast("Stopping", make(pipeline, pipeline.stopping))
