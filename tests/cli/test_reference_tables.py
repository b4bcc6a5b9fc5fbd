"""The reference has every declaration, and each its words."""

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
