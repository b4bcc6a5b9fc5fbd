"""Tables of the guides: made of the declarations, put between markers, found when out of date."""

import subprocess
import sys

import pytest

from support import guide_tables
from support.guide_tables import TABLES, main, outdated_tables, updated
from sweep.plan.parameters import PARAMETERS, SECTIONS
from sweep.plan.schema import VARIABLES

GUIDE = """# A guide

<!-- table: flags.estimate -->
anything old
<!-- /table -->

Text between.

<!-- table: parameters.pose -->
<!-- /table -->
"""


def rows(table):
    return [
        line for line in table.splitlines() if line.startswith("|") and "| ---" not in line
    ]


def test_every_parameter_variable_and_flag_has_a_row():
    for name in PARAMETERS:
        assert sum(row.startswith(f"| `{name}` ") for row in rows(TABLES["parameters"]())) == 1
    for section in SECTIONS:
        assert TABLES[f"parameters.{section}"]() in TABLES["parameters"]()
    variables = rows(TABLES["variables"]())[1:]
    assert [row.split("`")[1] for row in variables] == [*VARIABLES]
    for variable in VARIABLES.values():
        if variable.flags is not None:
            table = TABLES[f"flags.{variable.name}"]()
            assert [row.split("`")[1] for row in rows(table)[1:]] == [
                flag.name for flag in variable.flags
            ]


def test_all_rows_of_a_table_have_as_many_cells_as_its_header():
    for name, table in TABLES.items():
        for part in table().split("\n\n"):
            counts = {row.replace("\\|", "").count("|") for row in rows(part)}
            assert len(counts) <= 1, name


def test_tables_stand_between_their_markers_and_the_rest_is_left_alone():
    text = updated(GUIDE)
    assert "anything old" not in text
    assert TABLES["flags.estimate"]() in text
    assert TABLES["parameters.pose"]() in text
    assert "Text between." in text
    assert updated(text) == text


def test_a_table_out_of_date_is_named():
    assert outdated_tables(GUIDE) == ["flags.estimate", "parameters.pose"]
    text = updated(GUIDE)
    assert outdated_tables(text) == []
    assert outdated_tables(text.replace("`tilt_deg`", "`lean_deg`")) == ["parameters.pose"]


@pytest.mark.parametrize(
    ("text", "message"),
    [("<!-- table: flags.estimat -->\n<!-- /table -->", "did you mean flags.estimate"),
     ("<!-- table: flags -->\nnever closed", "without <!-- /table -->"),
     ("<!-- table: flags -->\n<!-- table: flags -->\n<!-- /table -->", "without <!-- /table -->")],
)
def test_a_marker_that_cannot_be_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        updated(text)


def test_the_command_writes_checks_and_lists(tmp_path, capsys):
    guide = tmp_path / "guide.md"
    guide.write_text(GUIDE)
    assert main(["--check", str(guide)]) == 1
    assert "out of date: flags.estimate, parameters.pose" in capsys.readouterr().err
    assert guide.read_text() == GUIDE
    assert main([str(guide)]) == 0
    assert main(["--check", str(guide)]) == 0
    assert guide.read_text() == updated(GUIDE)
    guide.write_text("<!-- table: nothing -->\n<!-- /table -->")
    assert main([str(guide)]) == 2
    listed = subprocess.run(
        [sys.executable, guide_tables.__file__], capture_output=True, text=True, check=True
    )
    assert listed.stdout.split() == list(TABLES)
