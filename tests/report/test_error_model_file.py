"""Error models as JSON: the reader of the guide gives the numbers of `model_errors`."""

import json
import math

import numpy as np
import pytest

from support.pose_errors import poses_with_law, power_law, reader_of_the_guide
from sweep.analysis import error_models, model_errors
from sweep.analysis.error_models import Use
from sweep.report.findings import error_model_document, error_model_table
from sweep.report.table import to_json

TITLE = 'a " */ quote\\ \n #include <x> {{ 7 * 7 }} {% raw %} """ \u2028 </script> \udcff'
ABOUT = {"store": 'runs/"odd" */ name.zarr', "title": TITLE, "fingerprint": {}}


@pytest.fixture(scope="module")
def models():
    axes = {"distance_m": [1.0, 2.0, 4.0], "tilt_deg": [0.0, 30.0, 60.0], "solver": ["a", TITLE],
            "trial": list(range(60))}
    return error_models(poses_with_law(8, axes, power_law, bearing_deg=20.0))


@pytest.fixture(scope="module")
def document(models):
    text = to_json(error_model_document(models, ABOUT))
    assert text.isascii()
    return json.loads(text, parse_constant=pytest.fail)


def test_the_reader_of_the_guide_gives_the_same_numbers(models, document):
    """Within and around the region, rounding apart."""
    rng = np.random.default_rng(1)
    z = np.exp(rng.uniform(np.log(0.9), np.log(4.5), 150))
    z[:3] = 1.0, 2.0, 4.0
    x, y = rng.uniform(-0.5, 0.5, (2, 150)) * z
    angle = rng.uniform(-5, 80, 150)
    angle[:3] = 0.0, 30.0, 60.0
    x[:3] = y[:3] = 0.0
    read = reader_of_the_guide()
    bearing = np.degrees(np.arctan2(np.hypot(x, y), z))
    wanted = [model_errors(models.isel(solver=k), z, angle, None, bearing) for k in (0, 1)]
    unseen = 0
    for n, (number, *position) in enumerate(zip(np.arange(150) % 2, x, y, z, strict=True)):
        found = read(document["models"][number], *position, angle[n])
        unseen += math.isnan(found["z"]["sigma"])
        for quantity, each in found.items():
            one = wanted[number].isel(pose=n).sel(quantity=quantity)
            for name in ("sigma", "bias"):
                np.testing.assert_allclose(each[name], one[name], rtol=1e-9, atol=1e-15)
            assert each["use"] == Use(int(one.use)).name
    assert 20 < unseen < 130
    assert math.isnan(read(document["models"][0], 0.0, 0.0, 0.0, 0.0)["z"]["sigma"])
    assert math.isnan(read(document["models"][0], 0.0, 0.0, -2.0, 0.0, 74.25)["z"]["sigma"])


def test_the_table_compares_the_usual_rule(models):
    table = error_model_table(models)
    assert table.headings[0] == "solver"
    assert {row[0] for row in table.rows} == {"a", TITLE}
    assert {row[table.headings.index("held-out check")] for row in table.rows} == {"few draws"}
    shown = table.as_json()["rows"][0]
    assert shown["0.02 d² / sigma z"]["value"] == pytest.approx(
        20 * shown["distance, m"] ** 2 / shown["z, mm"]["value"], rel=1e-3)
