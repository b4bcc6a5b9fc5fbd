"""Plug-ins of installed packages: found by name without being imported, recorded by version."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from support.blocks import run_cells
from sweep.cli import main
from sweep.errors import PipelineError, PluginError
from sweep.experiment.parameters import lacking_plugins
from sweep.experiment.pipeline import Pipeline
from sweep.plugins import loading
from sweep.store.provenance import fingerprint
from tests.plugins.test_detector_plugins import MINE

ENTRY_POINTS = """[sweep.detectors]
turned = fast_markers.detectors:TURNED
broken = fast_markers.nowhere:TURNED
[sweep.effects]
turned = fast_markers.detectors:TURNED
"""


def install(folder, name, version, entry_points=ENTRY_POINTS):
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(entry_points)
    return info


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder of packages, with one that offers plug-ins."""
    package = tmp_path / "fast_markers"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "detectors.py").write_text(MINE)
    install(tmp_path, "fast-markers", "1.2.3")
    monkeypatch.syspath_prepend(tmp_path)
    loading._of_entry_point.cache_clear()
    yield tmp_path
    loading._of_entry_point.cache_clear()
    for name in [name for name in sys.modules if name.startswith("fast_markers")]:
        del sys.modules[name]


TEXT = '[pose]\nside_px = 50\n[axes]\ndetector = ["opencv", "turned"]\nshift_px = [0, 1]\n'


def test_an_installed_detector_is_named_and_its_version_recorded(site):
    pipeline = Pipeline.from_text(TEXT)
    corners = run_cells(pipeline, []).columns["corner_error_px"]
    np.testing.assert_allclose(corners[3], corners[0] + 1, atol=1e-5)
    assert fingerprint(pipeline)["plugins"] == {"turned": {"fast-markers": "1.2.3"}}
    assert not pipeline.files
    assert not lacking_plugins(pipeline.plugins, ".")
    (site / "fast_markers-1.2.3.dist-info").rename(site / "fast_markers-1.3.dist-info")
    metadata = site / "fast_markers-1.3.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.2.3", "1.3"))
    assert lacking_plugins(pipeline.plugins, ".") == [
        "detector turned: expected fast-markers 1.2.3, not fast-markers 1.3"
    ]
    (plugin,) = pipeline.plugins
    with pytest.raises(PluginError):
        plugin.record(".")


@pytest.mark.usefixtures("site")
def test_names_are_listed_without_an_import(capsys):
    assert main(["plugins"]) == 0
    out = capsys.readouterr().out
    assert "detector   turned               of fast-markers" in out
    assert "detector   broken               of fast-markers" in out
    assert not any(name.startswith("fast_markers") for name in sys.modules)
    assert main(["plugins", "broken"]) == 2
    assert "ModuleNotFoundError: No module named 'fast_markers.nowhere'" in capsys.readouterr().err


@pytest.mark.usefixtures("site")
@pytest.mark.parametrize(("name", "told"), [
    ("broken", "a plug-in that can be imported: ModuleNotFoundError"),
    ("turnd", "did you mean turn"),
])
def test_an_installed_plug_in_that_cannot_be_used_is_one_line(name, told):
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(TEXT.replace("turned", name))
    (line,) = refused.value.faults
    assert f'axes.detector = "{name}": expected ' in line
    assert told in line


def test_a_name_that_two_packages_offer_is_refused(site):
    install(site, "slow-markers", "1.0", "[sweep.detectors]\nturned = slow:D\n")
    with pytest.raises(PipelineError, match="fast-markers and slow-markers both have it"):
        Pipeline.from_text(TEXT)
