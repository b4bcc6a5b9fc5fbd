"""Short names for the axes of charts, and whole meanings beside them."""

import sweep.analysis
from support.example_results import example_results
from sweep.declaration import declared_fields
from sweep.experiment.parameters import PARAMETERS, SECTIONS
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, short_name
from sweep.store.files import RECEIPTS
from sweep.store.lifecycle import planned_arrays

MAX_LINE = 30
"""Characters after which xarray breaks a label; three lines fit beside a chart."""

EVERYTHING = {
    "pose": {"side_px": {"uniform": [20, 40]}, "jitter_px": 0.5, "azimuth_deg": {
        "uniform": [0, 360]}},
    "scene": {"noise_grey": 2, "bound": "known_blur"},
    "axes": {"tilt_deg": [0, 30], "cornerRefinementMethod": ["none", "subpix"],
             "adaptiveThreshWinSizeMax": [13, 23], "trial": 2},
}


def test_every_array_of_a_store_has_a_short_name_and_its_meaning():
    pipeline = Pipeline.from_dict(EVERYTHING)
    for array in planned_arrays(pipeline, (1, 2)):
        if array.path != RECEIPTS and array.attributes:
            assert len(array.attributes["long_name"]) <= MAX_LINE + 2, array.path
            assert array.attributes["description"], array.path


def test_names_of_variables_and_parameters_are_short_and_distinct():
    names = {variable.name: variable.units for variable in SCHEMA} | {
        name: parameter.unit for name, parameter in PARAMETERS.items()}
    short = {name: short_name(name, units) for name, units in names.items()}
    assert max(map(len, short.values())) <= 40
    labels = [f"{short[name]} [{units}]" for name, units in names.items()]
    assert len(set(labels)) == len(labels)
    declared = [name for groups, _ in SECTIONS.values() for each in groups
                for name in declared_fields(each)]
    assert len(declared) == len(PARAMETERS)


def test_results_of_analyses_have_them_too():
    table = sweep.analysis.error_statistics(example_results())
    for each, variable in table.data_vars.items():
        assert len(variable.attrs["long_name"]) <= 42, each
        assert variable.attrs["description"], each
