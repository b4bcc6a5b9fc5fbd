"""Whether a block's flags and numbers agree: a number exists exactly where its flag says so.

Which flag governs which number is declared with the variables (``Variable.present_when``), and
beside which flags numbers exist with the flags (``Flag.present``).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LOST, UNSEEN, VARIABLES, Variable
from sweep.measure.flags import (
    BoundStatus,
    DetectionStatus,
    EstimateStatus,
    Flipped,
    present_values,
)
from sweep.store.blocks import region
from sweep.typing import Masks

Values = Mapping[str, NDArray[Any]]


def contradictions(store):
    """Return the contradictions within the blocks of a store."""
    found = (
        contradiction(store.pipeline, store.variables, {
            variable.name: np.asarray(
                store.array(variable.name)[region(variable, store.pipeline, block)])
            for variable in store.variables})
        for block in store.blocks
    )
    return [each for each in found if each]


def contradiction(
    pipeline: Pipeline, variables: Sequence[Variable], values: Values
) -> str:
    """Return the first contradiction within a block; empty if there is none.

    Parameters
    ----------
    pipeline
        The store's.
    variables
        The variables that the store has.
    values
        Those of a block by variable.
    """
    for variable in variables:
        if variable.flags is not None:
            unknown = ~np.isin(values[variable.name], [int(flag) for flag in variable.flags])
            if unknown.any():
                return f"{variable.name}: unknown flag {values[variable.name][unknown][0]}"
    unneeded = values["detection"] == DetectionStatus.not_needed
    if unneeded.any() and (fault := _not_needed_fault(pipeline, variables, values, unneeded)):
        return fault
    for variable in variables:
        if fault := _number_fault(pipeline, variable, values):
            return f"{variable.name}: {fault}"
    return _flag_contradiction(pipeline, values)


def _number_fault(pipeline: Pipeline, variable: Variable, values: Values) -> str:
    """Return how a variable's numbers contradict the flag that governs them."""
    rule = variable.present_when
    if rule is None:
        return ""
    governing = VARIABLES[rule.flag]
    if governing.flags is None:
        raise AssertionError(rule)
    numbers, flags = values[variable.name], values[rule.flag]
    if rule.number in ("unless_lost", "if_seen"):
        without = LOST if rule.number == "unless_lost" else UNSEEN
        computed = _any_configuration(pipeline, governing, variable, ~np.isin(flags, without))
        computed = computed.reshape(computed.shape + (1,) * len(variable.inner))
        missing = ~np.isfinite(numbers) & computed
        return "no number" if missing.any() else ""
    present = _spread(
        pipeline, governing, np.isin(flags, present_values(governing.flags)), variable
    )
    if rule.number == "always" and (~np.isfinite(numbers) & present).any():
        return f"no number although {rule.flag} says that there is one"
    if (~np.isnan(numbers) & ~present).any():
        return f"a number although {rule.flag} says that there is none"
    return ""


def _not_needed_fault(
    pipeline: Pipeline, variables: Sequence[Variable], values: Values, unneeded: Masks
) -> str:
    """Return what contradicts that scenes were not needed: nothing of them may be there."""
    detection = VARIABLES["detection"]
    scenes = _any_configuration(pipeline, detection, VARIABLES["bound"], unneeded)
    for variable in variables:
        found = _spread(pipeline, VARIABLES["bound"], scenes, variable)
        if variable.flags is None:
            if (found & ~np.isnan(values[variable.name])).any():
                return f"{variable.name}: a number of a scene that was not needed"
        elif ((values[variable.name] == variable.not_needed) != found).any():
            return f"{variable.name}: contradicts that scenes were not needed"
    return ""


def _flag_contradiction(pipeline: Pipeline, values: Values) -> str:
    """Return how the flags of different stages contradict each other."""
    detection, estimate = VARIABLES["detection"], VARIABLES["estimate"]
    needed = values["estimate"] != EstimateStatus.not_needed
    solved = values["estimate"] == EstimateStatus.solved
    flipped_exists = np.isin(values["flipped"], present_values(Flipped))
    no_estimate = values["flipped"] == Flipped.no_estimate
    if ((flipped_exists != solved) | (needed & (no_estimate == solved))).any():
        return "flipped: contradicts estimate"
    detected = _spread(
        pipeline, detection,
        np.isin(values["detection"], present_values(DetectionStatus)), estimate,
    )
    if (np.isin(values["estimate"], present_values(EstimateStatus)) & ~detected).any():
        return "estimate: a pose although nothing was detected"
    if (needed & ((values["estimate"] == EstimateStatus.no_detection) == detected)).any():
        return "estimate: contradicts detection"
    if (values["detection"] == DetectionStatus.not_run).any():
        return "detection: not run"
    computed = _any_configuration(
        pipeline, detection, VARIABLES["bound"], ~np.isin(values["detection"], LOST)
    )
    demanded = pipeline.fixed.get("bound", "none") != "none"
    if demanded and ((values["bound"] == BoundStatus.not_run) & computed).any():
        return "bound: not run"
    return ""


def _spread(
    pipeline: Pipeline, variable: Variable, values: NDArray[Any], wanted: Variable
) -> NDArray[Any]:
    """Return values of one variable's dimensions, shaped to broadcast to those of another."""
    names = variable.dimensions(pipeline)
    return values.reshape([
        values.shape[names.index(name)] if name in names else 1
        for name in wanted.dimensions(pipeline)
    ])


def _any_configuration(
    pipeline: Pipeline, variable: Variable, wanted: Variable, truth: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return for each scene whether ``truth`` holds in any configuration."""
    kept = wanted.dimensions(pipeline)
    others = tuple(
        k for k, name in enumerate(variable.dimensions(pipeline)) if name not in kept
    )
    return np.asarray(truth.any(axis=others))
