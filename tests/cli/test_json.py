"""JSON that commands print: the standard's numbers or null, and a flag beside an infinite one."""

import enum
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sweep.messages import to_json


def strict(text):
    """Return parsed JSON; a constant that the standard lacks is an error."""
    def refuse(name):
        raise AssertionError(name)

    return json.loads(text, parse_constant=refuse)


class Colour(enum.IntEnum):
    red = 3


@dataclass
class Found:
    value: float
    colour: Colour
    counts: dict


def test_each_kind_of_value_has_one_form():
    found = strict(to_json({
        "found": Found(-math.inf, Colour.red, {Colour.red: np.int64(2)}),
        "array": np.array([[1.0, np.inf], [np.nan, 2.0]]), "path": Path("a"), "many": (1, True),
        "none": None, "number": np.float32(0.5),
    }))
    assert found == {
        "found": {"value": None, "value_flag": "-infinite", "colour": "red", "counts": {"red": 2}},
        "array": [[1.0, None], [None, 2.0]], "array_flag": [[None, "infinite"], None],
        "path": "a", "many": [1, True], "none": None, "number": 0.5,
    }


def back(value, flag=None):
    """Return content without flags, from values and flags."""
    if isinstance(value, dict):
        return {name: back(item, value.get(f"{name}_flag"))
                for name, item in value.items() if not name.endswith("_flag")}
    if isinstance(value, list):
        return [back(item, flag and flag[k]) for k, item in enumerate(value)]
    return {"infinite": math.inf, "-infinite": -math.inf}.get(flag, value)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(st.sampled_from("abc"), st.recursive(
    st.sampled_from([None, True, 3, 0.5, math.inf, -math.inf, "inf", ""]),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.sampled_from("def"), inner, max_size=3),
    max_leaves=6,
)))
def test_every_infinity_is_told_beside_its_number(content):
    assert back(strict(to_json(content))) == content
