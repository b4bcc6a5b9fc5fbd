"""The recipe "add a flag": one is added in the one place that the recipe names."""

from __future__ import annotations

import pytest

from sweep.analysis.summaries import OUTCOMES
from sweep.measure.flags import EstimateStatus
from tests.support.recipes import added, printed_by

VALUE = len(EstimateStatus)

SENTENCE = "The pose is unlikely beforehand; it is stored."
MEMBER = f'    unlikely = flag({VALUE}, "{SENTENCE}", present=True)\n'

SCRIPT = """
import json
import numpy as np
import xarray as xr
from sweep.analysis import failure_composition
from sweep.evaluation.block import run_cells
from sweep.evaluation.results import to_dataset_layout
from support.flags_and_numbers import contradiction
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.grid import Block
from sweep.report.reference import TABLES
from sweep.experiment.schema import SCHEMA, VARIABLES

pipeline = Pipeline.from_text("[marker]\\nsize_m = 0.05\\n[axes]\\ndistance_m = [0.3, 0.5, 1e3]")
block = Block((0,), (3,))
columns = run_cells(pipeline.experiment, block.indices()).columns
values = {v.name: to_dataset_layout(v, pipeline, block, columns[v.name]) for v in SCHEMA}

def judged(**changed):
    kept = values | changed
    return contradiction(pipeline, SCHEMA, kept)

unlikely, flipped = values["estimate"].copy(), values["flipped"].copy()
unlikely[0], flipped[0] = EstimateStatus.unlikely, Flipped.no_estimate
lost = values["rotation_error_deg"].copy()
lost[0] = np.nan
results = xr.Dataset({
    name: (VARIABLES[name].dimensions(pipeline), array)
    for name, array in (values | {"estimate": unlikely, "flipped": flipped}).items()
})
shares = failure_composition(results)
print(json.dumps({
    "attributes": VARIABLES["estimate"].attributes(),
    "detected": (values["detection"] == DetectionStatus.detected).tolist(),
    "consistent": [
        judged(), judged(estimate=unlikely, flipped=flipped),
        judged(estimate=unlikely, flipped=flipped, rotation_error_deg=lost),
        judged(estimate=unlikely),
        judged(estimate=np.full_like(unlikely, len(EstimateStatus))),
    ],
    "outcomes": shares["outcome"].values.tolist(),
    "shares": shares["share"].sel(outcome=["unlikely", "solved", "no_candidate"]).values.tolist(),
    "tables": [TABLES["flags"]().rows, TABLES["variables"]().rows],
}))
"""


@pytest.mark.long
def test_flag_is_one_member(tmp_path):
    (last,) = (flag for flag in EstimateStatus if flag == VALUE - 1)
    anchor = f'"{last.meaning}")\n'
    result = printed_by(added(tmp_path, ("measure/flags.py", anchor, MEMBER)), SCRIPT)
    assert result["attributes"]["flag_values"] == list(range(VALUE + 1))
    assert result["attributes"]["flag_meanings"].split()[-1] == "unlikely"
    assert result["detected"] == [True, True, False]
    # Its pose must be stored, and the solution counts as no estimate for the flips.
    assert result["consistent"] == [
        "", "", "rotation_error_deg: no number although estimate says that there is one",
        "flipped: contradicts estimate", f"estimate: unknown flag {VALUE + 1}",
    ]
    assert set(result["outcomes"]) == {*OUTCOMES, "unlikely"}
    assert result["shares"] == [1 / 3, 1 / 3, 1 / 3]
    flags, variables = result["tables"]
    assert ["estimate", str(VALUE), "unlikely", SENTENCE, "yes"] in flags
    assert any("solved or not_explained or unlikely" in row[-1] for row in variables)
