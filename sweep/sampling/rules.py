"""The rule that samples, by what the pipeline says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sweep.plan.experiment import Pipeline
from sweep.plan.precision_rule import PrecisionRule
from sweep.sampling.precision import precision_sampling
from sweep.sampling.stopping import Stopping

RULES: Mapping[type, Callable[[Pipeline, Any], Stopping]] = {
    PrecisionRule: precision_sampling,
}
"""Class of what a section says -> the function that makes its rule, of a pipeline and the class.

The sections are in `sweep.plan.stopping.SECTIONS`. The function raises PipelineError with a line
for each name that it does not know.
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
    return RULES[type(pipeline.stopping)](pipeline, pipeline.stopping)
