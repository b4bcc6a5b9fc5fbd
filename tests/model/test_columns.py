"""Columns: the three forms in which a parameter's values come, behind one type."""

import numpy as np
import pytest

from sweep.model.columns import Column, map_columns

ARRAY = Column.of(np.array([1.0, 2.0]))
LIST = Column.of(["a", "b"])


def test_constants_arrays_and_lists_are_told_apart_once():
    assert Column.of(0.5).constant
    assert Column.of((0.1, 0.2)).constant  # a lens
    assert Column.of(np.float64(1)).constant
    assert not ARRAY.constant
    assert not LIST.constant
    assert Column.of(ARRAY) is ARRAY


def test_values_are_broadcast_and_listed():
    assert Column.of(2).broadcast(3).tolist() == [2.0, 2.0, 2.0]
    assert ARRAY.broadcast(2).flags.c_contiguous
    assert np.isnan(Column.of([None, 1]).broadcast(2)).tolist() == [True, False]
    keys = Column.of(np.array([2**64 - 1], dtype=np.uint64))
    assert keys.broadcast(1, np.uint64).tolist() == [2**64 - 1]
    assert Column.of("x").listed(2) == ["x", "x"]
    assert ARRAY.listed(2) == [1.0, 2.0]
    with pytest.raises(ValueError, match="broadcast"):
        ARRAY.broadcast(3)


def test_a_function_of_constants_is_called_once():
    calls = []
    column = map_columns(lambda a, b: calls.append((a, b)) or a + b, [Column.of(1), Column.of(2)])
    assert (column.values, column.constant) == (3, True)
    assert calls == [(1, 2)]


def test_a_function_of_columns_sees_the_values_of_each_scene():
    column = map_columns(lambda *row: row, [ARRAY, Column.of("c"), LIST])
    assert column.values == [(1.0, "c", "a"), (2.0, "c", "b")]
    assert LIST.map(str.upper).values == ["A", "B"]


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [(Column.of(1.0), 1, False), (Column.of(1.0), 2, True), (ARRAY, 1, True),
     (Column.of(np.ones(2)), 1, False), (Column.of(np.ones(2)), None, True),
     (Column.of(None), None, False), (LIST, "a", True), (Column.of(["a", "a"]), "a", False)],
)
def test_differs_from_asks_all_scenes(column, value, expected):
    assert column.differs_from(value) is expected


def test_missing_is_a_parameter_that_is_not_given():
    assert Column.of(None).missing
    assert not Column.of([None, None]).missing
    assert not ARRAY.missing
