"""Studies beside the guides: scripts and tables come out as their pages say."""

import contextlib
import importlib
import io
import re
import runpy
import subprocess
import sys
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
from scipy.stats import binom, binomtest

import sweep
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import DetectorSetting
from sweep.model.marker import modules

TOP = Path(__file__).parents[1]
PIPELINES = TOP / "pipelines"


# Half a pixel: the scripts are short, and print the figures of their guide.


def printed(name):
    with (
        contextlib.chdir(TOP), contextlib.redirect_stdout(io.StringIO()) as output,
        mock.patch.object(sys, "argv", [name]),
    ):
        runpy.run_path(str(PIPELINES / "half_pixel" / f"{name}.py"), run_name="__main__")
    return output.getvalue()


def numbers(text):
    return [float(each) for each in re.findall(r"[-+]?\d+\.\d+", text)]


def test_corners_of_the_thread_are_right_after_half_a_pixel():
    shift, before, after = printed("kallwies").splitlines()
    assert numbers(shift)[0] == pytest.approx(-0.551, abs=1e-3)
    assert numbers(before)[0] == pytest.approx(0.742, abs=1e-3)
    assert numbers(after)[0] < 0.1


def test_chessboard_corners_have_the_offset_of_the_installed_opencv():
    offset = numbers(printed("charuco").partition("offset")[2])
    fixed = tuple(map(int, cv2.__version__.split(".")[:2])) >= (4, 14)
    assert offset == pytest.approx([0.0 if fixed else 0.5] * 2, abs=0.02)


def test_centres_of_a_square_of_whole_pixels():
    lines = printed("apriltag").splitlines()
    assert [numbers(line.partition("square")[2])[:2] for line in lines[:3]] == [[149.5, 149.5]] * 3
    assert numbers(lines[3].partition("square")[2])[:2] == pytest.approx([150, 150], abs=0.1)


def test_the_closed_form_is_what_solve_pnp_makes_of_half_a_pixel():
    lines = printed("cost").splitlines()[2:]
    assert len(lines) == 12
    for line in lines:
        _, _, sideways, found, direction, turned = map(float, line.strip("| ").split("|"))
        assert found == pytest.approx(sideways, rel=0.04, abs=0.005)
        assert turned == pytest.approx(direction, rel=0.04, abs=1e-3)


@pytest.mark.evidence
def test_rendered_boxes_have_the_mean_error_of_the_paper():
    """4,096 scenes: half a pixel is 0.62 mm within 5 %, and gone with one convention."""
    lines = printed("fmac").splitlines()
    for mean in numbers(lines[-1]):
        assert mean == pytest.approx(0.62, rel=0.05)
    for low, high in re.findall(r"\((\S+) to (\S+)\)", lines[1]):
        assert float(low) < 0 < float(high)
    first, second = printed("locus").splitlines()
    assert numbers(second)[:2] == pytest.approx([-0.65, -0.61], abs=0.01), (first, second)


@pytest.mark.parametrize(("settings", "said"), [
    (["cx_px=320", "cy_px=240"], "the middle is 319.5, 239.5"),
    (['cornerRefinementMethod=["subpix", "apriltag"]'], "0.4 to 0.5 px"),
])
def test_pairs_that_are_not_consistent_are_said(settings, said):
    smoke = PIPELINES / "smoke.toml"
    notes = sweep.Pipeline.from_toml(smoke, settings).facts.notes
    assert [line for line in notes if said in line and "half_pixel" in line]
    assert not [line for line in sweep.Pipeline.from_toml(smoke).facts.notes if "half_" in line]

# Rates of false markers: the closed form, the exact interval, and OpenCV on random bits.

RATES = runpy.run_path(str(PIPELINES / "false_positives" / "rates.py"))


@pytest.mark.parametrize(("false", "candidates"), [(0, 9), (3, 57), (9, 9)])
def test_the_interval_is_scipys_exact_one(false, candidates):
    known = binomtest(false, candidates).proportion_ci(0.95, "exact")
    assert RATES["interval"](false, candidates) == pytest.approx((known.low, known.high))


@pytest.mark.parametrize(("name", "rate"), [("4X4_1000", 0.6), ("APRILTAG_16h5", 1.0)])
def test_random_bits_are_read_as_often_as_the_closed_form_says(name, rate):
    """The probability that a sound count is refused is below 1e-6 (binomial)."""
    dictionary, generator = RATES["dictionary_of"](name), np.random.default_rng(1)
    images = [RATES["random_codes"](generator, dictionary.markerSize) for _ in range(8)]
    squares = RATES["SQUARES"] * len(images)
    false, _ = RATES["count"](images, dictionary, rate)
    low, high = binom.interval(1 - 1e-6, squares, RATES["closed_form"](dictionary, rate))
    assert low <= false <= high


# The scripts that show faults of OpenCV are short, need nothing of ours, and find them.

FINDINGS = PIPELINES / "opencv_findings"
SCRIPTS = sorted(path for path in FINDINGS.glob("*.py") if path.name != "table.py")
GUIDE = (FINDINGS / "README.md").read_text()
FOUND = (FINDINGS / "found.txt").read_text()
VARIES = "apriltag_deglitch"


def test_the_guide_and_the_stored_table_have_every_finding():
    for path in SCRIPTS:
        assert f"| [`{path.stem}`]({path.name}) |" in GUIDE
        assert f"| [`{path.stem}`]({path.name}) |" in FOUND


@pytest.mark.evidence
def test_findings_are_those_of_the_stored_table():
    """The table's rows of the installed OpenCV come out again."""
    done = subprocess.run([sys.executable, FINDINGS / "table.py"], capture_output=True, text=True,
                          check=True)
    rows = [line.split(" | ")[2] for line in done.stdout.splitlines()[2:] if VARIES not in line]
    assert len(rows) == len(SCRIPTS) - 1
    version = re.escape(cv2.__version__)
    known = re.findall(rf"\| [^|]*\b{version}\b[^|]*\| ([^|]* \|)", FOUND)
    assert set(rows) <= set(known)

# Published figures as pipelines: they can be read, and one of them comes out as its page says.

PUBLISHED = PIPELINES / "published"
NEEDS = {
    "apriltag_334": ("pupil_apriltags", "pyapriltags"), "fmac": (),
    "render_tag": ("pupil_apriltags", "locus"), "roboception_range": ("pyapriltags",),
}


@pytest.mark.parametrize("name", NEEDS)
def test_the_pipelines_can_be_read(name):
    for module in NEEDS[name]:
        pytest.importorskip(module)
    assert Pipeline.from_toml(PUBLISHED / f"{name}.toml").size(*Stage) > 1


def test_the_page_has_the_register_s_table():
    make = runpy.run_path(str(PUBLISHED / "make.py"))
    assert make["table"]() in (PUBLISHED / "README.md").read_text()
    assert len(make["entries"]()) >= 10
    for entry in make["entries"]().values():
        assert {"source", "read", "given", "assumed", "prediction", "measured"} <= entry.keys()
        assert make["verdict"](entry) == "hit" or entry["measured"]["explanation"]

# Which cells of a small upright marker the detector misreads, and where markers are lost for it, in
# a sweep that the model was not made from.

sys.path.insert(0, str(PIPELINES / "open_question"))
try:
    model, dips, shapes, sweeps = (
        importlib.import_module(name)
        for name in ("bit_reading", "dips", "quadrilaterals", "sweeps")
    )
finally:
    sys.path.pop(0)

DICTIONARY = "DICT_5X5_50"
WITH_THE_DIP = {0, 2, 4, 7}
"""Of IDs 0-9 of DICT_5X5_50."""
def test_rule_and_model_name_the_ids_that_have_the_second_dip():
    bits = np.array([modules(DICTIONARY, marker_id) for marker_id in range(10)])
    reading = model.reading_of(DICTIONARY, 640, 480, DetectorSetting())
    lone = {i for i in range(10) if model.lone_cells(bits[i]) > reading.corrected_bits}
    assert lone == WITH_THE_DIP
    rates = np.array([
        model.predicted_rates(bits, shapes.upright_corners(side), reading)
        for side in np.arange(18.8, 21.4, 0.2)
    ])
    assert set(np.flatnonzero(rates.min(axis=0) < 0.97)) == WITH_THE_DIP
    assert model.lone_cells(modules("DICT_4X4_50", 0)) == 0


@pytest.mark.long
def test_dips_of_a_sweep_held_back_are_where_and_as_deep_as_was_written_down(tmp_path, claim):
    one = sweeps.HELD_BACK[4]
    truth = sweeps.measured(one, sweep.run(one.pipeline(), store=tmp_path / "held_back.zarr"))
    model = one.rates(sweeps.written_down()[one.title][:, None])
    off = np.abs(model.mean - truth.mean)
    claim("detection rates of small markers, from their bits",
          "sweeps of which the model knew nothing", off.max())
    assert off.max() <= 0.1
    for mine, its in dips.pairs(model, truth):
        if mine is None or its is None:
            # A dip near the least prominence may be one for the one and not for the other.
            assert (mine or its).prominence < 0.12
        else:
            assert abs(mine.area_px2 / its.area_px2 - 1) <= 0.1
            assert abs(mine.lowest - its.lowest) <= 0.1
