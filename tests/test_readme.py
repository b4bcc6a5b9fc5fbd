"""What the README shows is what the project does."""

import re
from pathlib import Path

import numpy as np
import pytest

from sweep.cli import main
from sweep.evaluation.inspection import inspect_scene
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, cell

TOP = Path(__file__).parent.parent
README = (TOP / "README.md").read_text()


@pytest.mark.parametrize("path", sorted((TOP / "pipelines").glob("*.toml")), ids=lambda p: p.stem)
def test_every_pipeline_is_sound(path):
    pipeline = Pipeline.from_toml(path)
    assert pipeline.title
    assert pipeline.size(*Stage) > 1


def test_show_draws_a_scene_or_its_plain_image(tmp_path, capsys):
    smoke = str(TOP / "pipelines" / "smoke.toml")
    at = "distance_m=0.3,tilt_deg=45"
    for options in ([], ["--plain"], ["--full", "--plain"]):
        assert main(["show", smoke, "--at", at, "-o", str(tmp_path / "a.png"), *options]) == 0
        assert "detected, solved" in capsys.readouterr().out
        assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert main(["show", smoke, "--at", "tilt=3"]) == 2
    assert "unknown parameter; did you mean tilt_deg?" in capsys.readouterr().err
    assert main(["show", smoke, "--at", "marker_id=99"]) == 2
    assert "expected IDs from 0 to 49" in capsys.readouterr().err
    assert main(["show", smoke, "-o", "/proc/none/a.png"]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_close_look_is_that_of_the_run():
    pipeline = Pipeline.from_toml(TOP / "pipelines" / "smoke.toml")
    windowed = inspect_scene(cell(pipeline, "distance_m=0.3,trial=2"))
    framed = inspect_scene(cell(pipeline, "distance_m=0.3,trial=2"), whole_frame=True)
    assert framed.image.shape == (480, 640)
    left, top, right, bottom = windowed.window
    np.testing.assert_array_equal(framed.image[top:bottom, left:right], windowed.image)
    np.testing.assert_array_equal(framed.markers, windowed.markers)
    assert windowed.errors["rotation_error_deg"] > 0


def test_plan_says_what_a_run_takes(capsys):
    smoke = str(TOP / "pipelines" / "smoke.toml")
    assert main(["plan", smoke, "--set", "distance_m=[0.2, 0.3]"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"distance_m +2 +scene +0.2 ... 0.3 m", told)
    assert re.search(r"poses +240", told)
    assert re.search(r"time +(over )?\S+ (s|min|h)", told)
