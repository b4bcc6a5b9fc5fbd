"""Whether a block's flags and numbers agree: a number exists exactly where its flag says so.

Which flag governs which number is declared with the variables (``Variable.present_when``), and
beside which flags numbers exist with the flags (``Flag.present``).
"""

import numpy as np
import xarray as xr

from sweep.experiment.schema import LOST, UNSEEN, VARIABLES
from sweep.measure.flags import (
    BoundStatus,
    DetectionStatus,
    EstimateStatus,
    Flipped,
    present_values,
)


def contradiction(pipeline, variables, values):
    """Return the first contradiction within a block's values by variable; empty for none."""
    data = {v.name: xr.DataArray(values[v.name], dims=v.dimensions(pipeline)) for v in variables}
    return next((f"{name}: {fault}" for name, fault in faults(pipeline, variables, data)), "")


def in_any(truth, dims):
    """Return where ``truth`` holds in any configuration beyond ``dims``."""
    return truth.any([dim for dim in truth.dims if dim not in dims])


def faults(pipeline, variables, data):
    """Yield names of variables, and how they contradict others."""
    for variable in variables:
        if variable.flags is not None:
            flags = data[variable.name].values
            unknown = ~np.isin(flags, [int(flag) for flag in variable.flags])
            if unknown.any():
                yield variable.name, f"unknown flag {flags[unknown][0]}"
    scene = data["bound"].dims
    detection, estimate, flipped = (data[name] for name in ("detection", "estimate", "flipped"))
    unneeded = in_any(detection == DetectionStatus.not_needed, scene)
    for variable in variables if unneeded.any() else ():
        if variable.flags is None:
            if (unneeded & data[variable.name].notnull()).any():
                yield variable.name, "a number of a scene that was not needed"
        elif ((data[variable.name] == variable.not_needed) != unneeded).any():
            yield variable.name, "contradicts that scenes were not needed"
    for variable in variables:
        if variable.present_when is not None:
            yield from number_faults(variable, data)
    needed, solved = estimate != EstimateStatus.not_needed, estimate == EstimateStatus.solved
    no_estimate = flipped == Flipped.no_estimate
    if ((flipped.isin(present_values(Flipped)) != solved)
            | (needed & (no_estimate == solved))).any():
        yield "flipped", "contradicts estimate"
    detected = detection.isin(present_values(DetectionStatus))
    if (estimate.isin(present_values(EstimateStatus)) & ~detected).any():
        yield "estimate", "a pose although nothing was detected"
    if (needed & ((estimate == EstimateStatus.no_detection) == detected)).any():
        yield "estimate", "contradicts detection"
    if (detection == DetectionStatus.not_run).any():
        yield "detection", "not run"
    computed = in_any(~detection.isin(LOST), scene)
    demanded = pipeline.fixed.get("bound", "none") != "none"
    if demanded and ((data["bound"] == BoundStatus.not_run) & computed).any():
        yield "bound", "not run"


def number_faults(variable, data):
    """Yield how a variable's numbers contradict the flag that governs them."""
    rule, numbers = variable.present_when, data[variable.name]
    flags, finite = data[rule.flag], np.isfinite(numbers)
    if rule.number in ("unless_lost", "if_seen"):
        lost = flags.isin(LOST if rule.number == "unless_lost" else UNSEEN)
        if (~finite & in_any(~lost, numbers.dims)).any():
            yield variable.name, "no number"
        return
    present = flags.isin(present_values(VARIABLES[rule.flag].flags))
    if rule.number == "always" and (~finite & present).any():
        yield variable.name, f"no number although {rule.flag} says that there is one"
    if (numbers.notnull() & ~present).any():
        yield variable.name, f"a number although {rule.flag} says that there is none"
