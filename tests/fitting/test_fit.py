"""Scenes that are fitted to photographs with known effects: rendered, saved, and fitted."""


import numpy as np
import pytest
import xarray as xr

import sweep
from support.fitted_photographs import EFFECTS, PLAIN, TRUTH, fitted, taken, terms_of
from sweep.analysis.simulation_gaps import QUANTILES, RATES
from sweep.fitting.folders import REPEATS, HeldOut


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("fit"), EFFECTS, 7, 6)


@pytest.mark.evidence
def test_every_effect_is_found_its_interval_holds_the_truth_and_the_scene_is_a_pipeline(found):
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
    pipeline = sweep.Pipeline.from_text(found.text)
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


def gap(simulated, photographs=1.0):
    """A gap whose statistics have these values, and intervals of ± 0.5 of the difference."""
    variables = {}
    for each in (*RATES, *QUANTILES):
        size = simulated - photographs
        for end, change in (("", 0.0), ("_low", -0.5), ("_high", 0.5)):
            variables[f"{each.name}_gap{end}"] = (
                "solver", np.full(2, np.exp(size + change) if each.ratio else size + change))
    return xr.Dataset(variables)


class Simulated(HeldOut):
    """Held-out photographs whose simulations have known gaps: a scene's ``value``."""

    def gap(self, scene, name):  # noqa: ARG002
        return gap(scene["value"])


def test_an_effect_is_left_out_where_errors_are_clearly_nearer_to_those_of_photographs_without():
    photographs = Simulated(None, None, None, None)
    full = gap(1.5)
    # Without an effect the gap of 1 half-width becomes 2, 1, 0.8, and, though the errors move by as
    # much as in the first case, 0.2 on the other side.
    scenes = {"nearer": {"value": 2.0}, "idle": {"value": 1.5}, "open": {"value": 1.4},
              "moved": {"value": 0.9}}
    assert photographs.worth(full, scenes) == {
        "nearer": True, "idle": True, "open": True, "moved": False}


@pytest.mark.evidence
def test_a_scene_is_checked_against_photographs_that_were_not_fitted(tmp_path, capsys):
    # The shifts are so large that their absence is seen: with 0.15 px, as in EFFECTS, ten
    # photographs do not always tell that they matter.
    effects = EFFECTS | {"sharpening": 1.2, "bloom": 0.4, "geometry_px": 0.3}
    folders, options = taken(tmp_path, effects, 31, 10)
    fitted = sweep.fit(*folders, **options, markers=6)
    said = capsys.readouterr().err
    assert "fitting photograph 6 of 10" in said
    assert "simulating them with all but edge_px" in said
    assert {"blur_px", "sharpening", "bloom", "geometry_px"} <= set(fitted.found.scene)
    assert terms_of(fitted)["geometry_px"].kept
    simulated = fitted.gap.sel(source="simulated", cornerRefinementMethod="subpix")
    real = fitted.gap.sel(source="photographs", cornerRefinementMethod="subpix")
    assert simulated.looked_for == REPEATS * real.looked_for
    ratio = float(simulated.rotation_median_deg / real.rotation_median_deg)
    assert 1 / 1.6 < ratio < 1.6
