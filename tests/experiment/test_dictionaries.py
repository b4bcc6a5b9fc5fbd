"""Pipelines of nested dictionaries: the same document, checks and messages as a file's."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.documents import any_document
from support.lengths import lengths
from sweep.errors import PipelineError
from sweep.experiment.document import document_text, read_document
from sweep.experiment.pipeline import Pipeline

CHARACTERS = st.characters(categories=["L", "N", "P"], include_characters='"\\\' ')
SOLVERS = {
    "axes": {"solver": ["ippe", "sqpnp"], "marker_id": {"range": [1, 9, 3]},
             "noise_grey": {"linspace": [0, 1, 4]}},
    "estimator": {"guarded": False},
}


@lengths(40, 400)
def test_text_of_a_pipeline_reads_back_to_an_equal_one(count):
    @settings(max_examples=count, deadline=None)
    @given(st.integers(0, 2**63 - 1), st.text(CHARACTERS, max_size=20), st.booleans())
    def check(seed, title, more):
        title = "".join(filter(str.isprintable, title))
        document = any_document(np.random.default_rng(seed)) | {"title": title, "seed": seed}
        if more:
            document = SOLVERS | document | {"axes": document["axes"] | SOLVERS["axes"]}
        pipeline = Pipeline.from_dict(document, name="a")
        assert Pipeline.from_text(pipeline.to_toml(), name="a") == pipeline

    check()


@lengths(50, 500)
def test_any_document_is_written_as_toml_that_means_the_same(count):
    values = st.recursive(
        st.one_of(st.booleans(), st.integers(), st.floats(allow_nan=False), st.dates(),
                  st.text(max_size=9)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner,
                                                                    max_size=3),
        max_leaves=8,
    )

    @settings(max_examples=count, deadline=None)
    @given(st.dictionaries(st.text(max_size=5), values, max_size=4))
    def check(document):
        try:
            text = document_text(document)
            text.encode()
        except UnicodeEncodeError:
            return  # a lone surrogate is no UTF-8
        assert read_document(text) == document

    check()


def test_values_of_python_and_numpy_stand_for_those_of_toml(tmp_path):
    pipeline = Pipeline.from_dict({
        "seed": np.int64(3),
        "camera": {"distortion": (0.1, 0.2, 0, 0), "width_px": np.int32(320)},
        "pose": {"roll_deg": np.float32(0.5)},
        "axes": {"distance_m": np.linspace(0.1, 1, 4), "marker_id": range(2, 10, 3)},
    })
    assert pipeline.seed == 3
    assert pipeline.fixed["distortion"] == (0.1, 0.2, 0.0, 0.0)
    assert pipeline.fixed["width_px"] == 320
    assert pipeline.axis("distance_m").values == tuple(np.linspace(0.1, 1, 4).tolist())
    assert pipeline.axis("marker_id").values == range(2, 10, 3)
    with pytest.raises(PipelineError, match="expected a level or an image file"):
        Pipeline.from_dict(
            {"pose": {"distance_m": 1}, "scene": {"background": Path("none.png")}},
            folder=tmp_path,
        )


def test_settings_replace_values_axes_and_distributions(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text("# kept\n[pose]\ndistance_m = 1\n[axes]\ntilt_deg = [0, 1]")
    pipeline = Pipeline.from_toml(
        path,
        ["tilt_deg=5", "distance_m=[1, 2]", "roll_deg={uniform = [0, 90]}", "solver=sqpnp",
         "trial=3", "distortion=[[], [0.1, 0, 0, 0]]", "seed=7"],
    )
    assert pipeline.fixed["tilt_deg"] == 5.0
    assert [axis.name for axis in pipeline.axes] == ["distance_m", "trial", "distortion"]
    assert pipeline.fixed["solver"] == "sqpnp"
    assert str(pipeline.distributions["roll_deg"]) == "uniform(0,90)"
    assert pipeline.seed == 7
    assert pipeline.text.startswith("# kept")
    again = Pipeline.from_text(pipeline.text)
    assert (again.fixed, again.axes) == (pipeline.fixed, pipeline.axes)


LOOP = {}
LOOP["pose"] = {"distance_m": LOOP}


@pytest.mark.parametrize(
    ("document", "message"),
    [({"pose": {"distance_m": None}}, "cell: pose.distance_m = None: expected a string, a number"),
     ({"pose": {"distance_m": 1}, "axes": {"tilt_deg": {1, 2}}},
      "axes.tilt_deg = {1, 2}: expected"),
     ({"pose": {3: 1}}, "cell: pose.3 = 1: expected a string"),
     ({"pose": {"distance_m": 1j}, "seed": None}, "seed = None: .*\n.*pose.distance_m = 1j: "),
     ({"pose": {"distance": 1}}, "pose.distance: unknown key; did you mean distance_m"),
     ({"axes": {"distance_m": np.arange(1.0, 40_000)}}, "expected at most 250,000 bytes"),
     (LOOP, "cell: pose.distance_m = .*: expected a string")],
)
def test_values_that_toml_does_not_have_are_told_by_key(document, message):
    with pytest.raises(PipelineError, match=message):
        Pipeline.from_dict(document, source="cell")
