"""The recipe "add a flag": one is added in the one place that the recipe names."""

import pytest

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
from sweep.measure.flags import EstimateStatus, Flipped
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.grid import Block
from sweep.report.reference import TABLES
from sweep.experiment.schema import SCHEMA, VARIABLES

pipeline = Pipeline.from_text("[marker]\\nsize_m = 0.05\\n[axes]\\ndistance_m = [0.3, 0.5, 1e3]")
block = Block((0,), (3,))
columns = run_cells(pipeline.experiment, block.indices()).columns
values = {v.name: to_dataset_layout(v, pipeline, block, columns[v.name]) for v in SCHEMA}
unlikely, flipped = values["estimate"].copy(), values["flipped"].copy()
unlikely[0], flipped[0] = EstimateStatus.unlikely, Flipped.no_estimate
lost = values["rotation_error_deg"].copy()
lost[0] = np.nan
new = {"estimate": unlikely, "flipped": flipped}
results = xr.Dataset({
    name: (VARIABLES[name].dimensions(pipeline), array) for name, array in (values | new).items()
})
shares = failure_composition(results)["share"]
print(json.dumps([
    VARIABLES["estimate"].attributes(),
    [contradiction(pipeline, SCHEMA, values | changed) for changed in (
        {}, new, new | {"rotation_error_deg": lost}, {"estimate": unlikely},
        {"estimate": np.full_like(unlikely, len(EstimateStatus))},
    )],
    shares.sel(outcome=["unlikely", "solved", "no_candidate"]).values.tolist(),
    [TABLES["flags"]().rows, TABLES["variables"]().rows],
]))
"""


@pytest.mark.long
def test_flag_is_one_member(tmp_path):
    (last,) = (flag for flag in EstimateStatus if flag == VALUE - 1)
    change = "measure/flags.py", f'"{last.meaning}")\n', MEMBER
    attributes, contradictions, shares, tables = printed_by(added(tmp_path, change), SCRIPT)
    assert attributes["flag_values"] == list(range(VALUE + 1))
    assert attributes["flag_meanings"].split()[-1] == "unlikely"
    # Its pose must be stored, and the solution counts as no estimate for the flips.
    assert contradictions == [
        "", "", "rotation_error_deg: no number although estimate says that there is one",
        "flipped: contradicts estimate", f"estimate: unknown flag {VALUE + 1}",
    ]
    assert shares == [1 / 3, 1 / 3, 1 / 3]
    assert ["estimate", str(VALUE), "unlikely", SENTENCE, "yes"] in tables[0]
    assert any("solved or not_explained or unlikely" in row[-1] for row in tables[1])
