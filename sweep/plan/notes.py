"""What may surprise of a pipeline, in a line each: of its camera, and of its poses."""

from __future__ import annotations

from sweep.plan import camera_facts
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.experiment import Pipeline
from sweep.plan.pose_facts import pose_facts, pose_notes


def notes(pipeline: Pipeline) -> list[str]:
    """Return the lines that `sweep plan` and the start of a run print."""
    if PHOTOGRAPHS in pipeline.given:
        return []
    return [*camera_facts.notes(pipeline), *pose_notes(pipeline, pose_facts(pipeline))]
