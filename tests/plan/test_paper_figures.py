"""The pipelines of the paper's figures are those of its figures (Poroykov et al., 2020).

Figure 3 is the error against the area of a marker perpendicular to the camera, figure 4 the
probability of detection against area at tilts of 0, 45 and 70 degrees.
"""

from pathlib import Path

import pytest

import sweep

ROOT = Path(__file__).parents[2]
SAID = {3: ("error", "detection"), 4: ("detection", "error")}


@pytest.mark.parametrize(("figure", "tilts"), [(3, [0]), (4, [0, 45, 70])])
def test_pipeline_of_a_figure_has_its_tilts_and_its_title(figure, tilts):
    pipeline = sweep.Pipeline.from_toml(ROOT / "pipelines" / f"paper_fig{figure}.toml")
    assert list(pipeline.values_of("tilt_deg")) == tilts
    shown, not_shown = SAID[figure]
    assert shown in pipeline.title.lower()
    assert not_shown not in pipeline.title.lower()
    assert f"figure {figure}" in pipeline.title


def test_guide_and_notebook_call_the_figures_as_the_paper_does():
    notebook = (ROOT / "notebooks" / "paper_reproduced.ipynb").read_text(encoding="utf-8")
    assert "## Figure 4: probability of detection" in notebook
    assert "## Figure 3: error of the pose" in notebook
    guide = (ROOT / "pipelines" / "README.md").read_text(encoding="utf-8")
    [row] = [line for line in guide.splitlines() if "(paper_fig3.toml)" in line]
    assert row.index("3, the error") < row.index("4, the probability of detection")
