"""The scripts about half a pixel are short, and print the figures of their guide."""

import contextlib
import io
import re
import runpy
import sys
from pathlib import Path
from unittest import mock

import cv2
import pytest

import sweep

TOP = Path(__file__).parents[1]
FOLDER = TOP / "pipelines" / "half_pixel"


def printed(name):
    with (
        contextlib.chdir(TOP), contextlib.redirect_stdout(io.StringIO()) as output,
        mock.patch.object(sys, "argv", [name]),
    ):
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
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
    smoke = TOP / "pipelines" / "smoke.toml"
    notes = sweep.Pipeline.from_toml(smoke, settings).facts.notes
    assert [line for line in notes if said in line and "half_pixel" in line]
    assert not [line for line in sweep.Pipeline.from_toml(smoke).facts.notes if "half_" in line]
