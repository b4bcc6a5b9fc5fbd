"""The reference has every declaration, and a name that it lacks is told in a line."""

import json

import sweep
from sweep.cli import main
from sweep.cli.reference import TABLES
from sweep.experiment.parameters import PARAMETERS, SECTIONS
from sweep.experiment.schema import VARIABLES


def test_every_parameter_and_variable_stands_in_the_table_of_its_subject():
    for section in SECTIONS:
        names = [row[0] for row in TABLES[section]().rows]
        assert names == [p.name for p in PARAMETERS.values() if p.section == section]
    assert [row[0] for row in TABLES["variables"]().rows] == [*VARIABLES]
    assert all(all(row[-1:]) for name in TABLES for row in TABLES[name]().rows
               if name != "variables")


def test_terminal_json_and_python_have_the_same_rows(capsys):
    assert main(["reference", "tilt_deg", "flags"]) == 0
    text = capsys.readouterr().out
    assert main(["reference", "tilt_deg", "flags", "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers == sweep.reference("tilt_deg", "flags").numbers
    assert all(row["flag"] in text for row in numbers["flags"])
