"""Scenes that are fitted to photographs with known effects: rendered, saved, and fitted."""

import numpy as np
import pytest

import sweep
from support.fitted_photographs import EFFECTS, PLAIN, TRUTH, fitted, terms_of
from sweep import cli
from sweep.errors import ArgumentError


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("fit"), EFFECTS, 7, 6)


@pytest.mark.evidence
def test_every_effect_is_found_and_its_interval_holds_the_truth(found):
    terms = terms_of(found)
    for name, value in TRUTH.items():
        if name == "background":  # of photographs it is the board's squares beside the marker
            continue
        one = terms[name].estimate
        assert terms[name].kept, name
        # One in twenty 95 % intervals misses; with five degrees of freedom, twice as wide ones
        # hold the truth with a probability of 0.9965.
        half = (one.high - one.low) / 2
        assert abs(one.value - value) < 2 * half + 1e-9, name
    deviations = terms["noise_table"].setting
    assert np.allclose(deviations[1::2], 2.0, rtol=0.1)


@pytest.mark.evidence
def test_the_scene_is_a_pipeline_that_runs(found, tmp_path, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(found.text)
    assert cli.main(["plan", str(path)]) == 0
    assert "sharpening" in capsys.readouterr().out
    pipeline = sweep.Pipeline.from_toml(path)
    assert pipeline.fixed["blur_px"] == pytest.approx(0.6, rel=0.03)
    assert "# Fitted to 36 markers in 6 photographs" in found.text


@pytest.mark.evidence
def test_effects_that_are_not_there_are_left_out_and_the_file_says_why(tmp_path):
    plain = fitted(tmp_path, PLAIN, 8, 4, 4)
    terms = terms_of(plain)
    assert terms["blur_px"].kept
    assert terms["blur_px"].estimate.value == pytest.approx(0.5, abs=0.02)
    absent = [name for name in ("sharpening", "bloom", "geometry_px") if not terms[name].kept]
    assert len(absent) >= 2  # a false alarm of each has a probability of 5 %
    for name in absent:
        assert f"#   left out: {terms[name].name}: {terms[name].reason}\n" in plain.text
        assert name not in plain.found.scene


@pytest.mark.parametrize(("change", "message"), [
    ({"markers": 0}, "markers = 0: expected a whole number from 1 to 1000"),
    ({}, "expected photographs"),
])
def test_bad_arguments_are_one_line(change, message, tmp_path):
    with pytest.raises(ArgumentError, match=message):
        sweep.fit(tmp_path, camera="calibrate", **change)
