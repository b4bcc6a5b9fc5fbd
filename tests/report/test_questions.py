"""Questions as users ask them: short files whose requirements can be decided."""

from pathlib import Path

import pytest

from sweep.analysis.requirements import check_required
from sweep.experiment.pipeline import Pipeline

FOLDER = Path(__file__).parents[2] / "pipelines" / "questions"
QUESTIONS = sorted(path.stem for path in FOLDER.glob("*.toml"))
MAX_LINES = 12


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_question_is_short_and_what_it_requires_can_be(name):
    path = FOLDER / f"{name}.toml"
    assert path.read_text().count("\n") <= MAX_LINES
    pipeline = Pipeline.from_toml(path)
    check_required(pipeline.requirements, str(path))
    assert f"({name}.toml)" in (FOLDER / "README.md").read_text()
