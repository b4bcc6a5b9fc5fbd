"""Tables of the guides: made of the declarations, put between markers, found when out of date."""

import pytest

from support.guide_tables import TABLES, main, outdated_tables, updated
from sweep.experiment.parameters import PARAMETERS, SECTIONS
from sweep.experiment.schema import VARIABLES

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


def test_tables_stand_between_their_markers_and_the_rest_is_left_alone():
    text = updated(GUIDE)
    assert "anything old" not in text
    assert TABLES["flags.estimate"]() in text
    assert TABLES["parameters.pose"]() in text
    assert "Text between." in text
    assert updated(text) == text


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
    changed = guide.read_text().replace("`tilt_deg`", "`lean_deg`")
    assert outdated_tables(changed) == ["parameters.pose"]
    guide.write_text("<!-- table: nothing -->\n<!-- /table -->")
    assert main([str(guide)]) == 2
    capsys.readouterr()
    assert main([]) == 0
    assert capsys.readouterr().out.split() == list(TABLES)
