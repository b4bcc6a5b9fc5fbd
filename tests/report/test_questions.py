"""Questions as users ask them: short files, and answers on the first screen of the report."""

import json
from pathlib import Path

import pytest

from support.reports import command, made
from sweep.analysis.requirements import check_required
from sweep.experiment.pipeline import Pipeline

FOLDER = Path(__file__).parents[2] / "pipelines" / "questions"
QUESTIONS = sorted(path.stem for path in FOLDER.glob("*.toml"))
MAX_LINES = 12

ANSWERS = {
    "how_far": (["distance_m=[0.5, 3]", "tilt_deg=[0, 60]"], "up to 0.5 m"),
    "which": (["distance_m=[0.5, 2]"], " against "),
    "which_size": (["size_m=[0.06, 0.4]", "tilt_deg=[0, 60]"], "0.4 m"),
    "flips": (["tilt_deg=[5, 30]"], "along tilt_deg"),
    "focal_length": (["distance_m=[0.5, 1.5]"], " against believed_focal_scale 0.99 (wrong): "),
    "field_of_view": (["hfov_deg=[30, 110]", "tilt_deg=[0, 60]"], "up to 30"),
    "blur": (["blur_px=[0, 3]"], "along blur_px: up to 0 px"),
    "dictionary": (["side_px=[15, 40]"], "down to 40 px"),
    "threshold": (["adaptiveThreshConstant=[2, 7, 15]"], " against "),
    "room": ([], "Detected in "),
}
"""Few values of each axis, and a part of the first sentence."""


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_question_is_short_and_what_it_requires_can_be(name):
    path = FOLDER / f"{name}.toml"
    assert path.read_text().count("\n") <= MAX_LINES
    pipeline = Pipeline.from_toml(path)
    check_required(pipeline.requirements, str(path))
    assert name in ANSWERS
    assert f"({name}.toml)" in (FOLDER / "README.md").read_text()


@pytest.mark.evidence
@pytest.mark.parametrize("name", QUESTIONS)
def test_the_first_sentence_answers_the_question(name, tmp_path):
    settings, sentence = ANSWERS[name]
    trials = 8 if name == "focal_length" else 150
    url = made(tmp_path, (FOLDER / f"{name}.toml").read_text(), name,
               settings=[*settings, f"trial={trials}"])
    code, out, err = command("report", url, "-o", tmp_path / "report.html", "--json")
    assert (code, err) == (0, "")
    shown = json.loads(out)
    assert sentence in shown["answer"]
    if name == "focal_length":
        (table,) = (each for each in shown["tables"]
                    if each["caption"].startswith("Configurations, with"))
        assert shown["configuration"] == "believed_focal_scale 1.0"
        bias = [row["range bias, %"]["value"] for row in sorted(
            table["rows"], key=lambda row: row["configuration"])]
        assert bias[0] - bias[1] == pytest.approx(-1, abs=0.05)
        assert bias[2] - bias[1] == pytest.approx(1, abs=0.05)
