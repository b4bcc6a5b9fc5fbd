"""Markers of AprilTag's and STag's own families, against the libraries that they are from."""

import ctypes
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sweep import Pipeline, PipelineError
from sweep.evaluation.inspection import scene_image
from sweep.model import marker as stag
from sweep.model import marker as tag_families
from sweep.model.marker import (
    STAG_LIBRARIES,
    TAG_FAMILIES,
    marker_count,
    module_count,
    modules,
    overhang,
)

TEXT = """
title = "A marker"
[camera]
width_px = 320
height_px = 240
fx_px = 600.0
fy_px = 600.0
[marker]
dictionary = "{dictionary}"
marker_id = {marker_id}
[pose]
side_px = 90
tilt_deg = 25
azimuth_deg = 70
roll_deg = 140
[detector]
detector = "{detector}"
[scene]
background = 90
"""


def text_of(dictionary, marker_id, extra=""):
    detector = "stag-python" if dictionary.startswith("STAG") else "pyapriltags"
    return TEXT.format(dictionary=dictionary, marker_id=marker_id, detector=detector) + extra


def image(dictionary, marker_id, extra=""):
    pipeline = Pipeline.from_text(text_of(dictionary, marker_id, extra))
    return np.ascontiguousarray(scene_image(pipeline, whole_frame=True))


class AprilTagImage(ctypes.Structure):
    _fields_ = (
        ("width", ctypes.c_int), ("height", ctypes.c_int), ("stride", ctypes.c_int),
        ("buf", ctypes.POINTER(ctypes.c_uint8)),
    )


@pytest.mark.parametrize("family", TAG_FAMILIES)
def test_modules_of_tag_families_are_those_that_apriltag_draws(family):
    pyapriltags = pytest.importorskip("pyapriltags")
    library = ctypes.CDLL(str(Path(pyapriltags.__file__).parent / "libapriltag.so"))
    create = getattr(library, f"{family}_create")
    create.restype = ctypes.c_void_p
    library.apriltag_to_image.restype = ctypes.POINTER(AprilTagImage)
    library.apriltag_to_image.argtypes = (ctypes.c_void_p, ctypes.c_uint32)
    made = create()
    _, positions = tag_families._codes(family)
    start, size = overhang(family), module_count(family) + 2 * overhang(family)
    used = np.zeros((size, size), dtype=bool)
    used[tuple((positions + start).T[::-1])] = True
    used[start - 1 : -start + 1, start - 1 : -start + 1] |= np.pad(
        np.zeros((size - 2 * start - 2, size - 2 * start - 2), dtype=bool), 2, constant_values=True
    )
    rng = np.random.default_rng(5)
    for marker_id in (0, *rng.integers(marker_count(family), size=20).tolist()):
        drawn = library.apriltag_to_image(made, marker_id).contents
        theirs = np.ctypeslib.as_array(drawn.buf, (drawn.height, drawn.stride))[:, : drawn.width]
        ours = modules(family, marker_id)
        assert ours.shape == theirs.shape
        assert ((theirs > 127) == ours)[used].all()
        assert ours[~used].all()


CODES = """
import sys
from sweep.model import marker as tag_families
tag_families.PACKAGES = (sys.argv[1],)
for family in tag_families.TAG_FAMILIES:
    print(family, [part.tolist() for part in tag_families._codes(family)])
"""


@pytest.mark.system
def test_both_packages_have_the_same_codes():
    # Each in a process of its own: both packages wrap versions of one library.
    for package in tag_families.PACKAGES:
        pytest.importorskip(package)
    read = [
        subprocess.run(
            [sys.executable, "-c", CODES, package], capture_output=True, check=True
        ).stdout for package in tag_families.PACKAGES
    ]
    assert read[0]
    assert all(each == read[0] for each in read)


@pytest.mark.parametrize("library", STAG_LIBRARIES)
def test_stag_reads_the_markers_that_are_drawn(library):
    package = pytest.importorskip("stag")
    last = marker_count(library) - 1
    for marker_id in sorted({0, last // 2, last}):
        _, ids, _ = package.detectMarkers(image(library, marker_id), int(library[-2:]))
        assert np.ravel(ids).tolist() == [marker_id]


def test_stag_image_is_that_of_many_samples():
    pytest.importorskip("stag")
    dictionary, marker_id = "STAG_HD19", 7
    text = text_of(dictionary, marker_id).replace(
        "tilt_deg = 25", "tilt_deg = 0").replace("roll_deg = 140", "roll_deg = 0")
    drawn = scene_image(Pipeline.from_text(text), whole_frame=True).astype(float)
    # 20 samples along a side of a pixel, each black or white by the distances to the circles.
    samples, side, left, top = 20, 90.0, 100, 60
    u = left + (np.arange(120 * samples) + 0.5) / samples - 0.5
    v = top + (np.arange(120 * samples) + 0.5) / samples - 0.5
    x, y = np.meshgrid(
        (u - 159.5) / side * stag.STAG_MODULES + 4, (v - 119.5) / side * stag.STAG_MODULES + 4
    )
    across = np.maximum(np.abs(x - 4), np.abs(y - 4))
    level = np.where(across <= 5, 255.0, 90.0)
    level[across <= 4] = 0
    level[np.hypot(x - 4, y - 4) <= stag.CIRCLE_RADIUS] = 255
    code = int(stag._stag_codes(dictionary)[marker_id])
    for bit, (centre_x, centre_y) in enumerate(stag.dot_centres()):
        if code >> bit & 1:
            level[np.hypot(x - centre_x, y - centre_y) <= stag.DOT_RADIUS] = 0
    sampled = level.reshape(120, samples, 120, samples).mean(axis=(1, 3))
    drawn = drawn[top : top + 120, left : left + 120]
    assert np.abs(drawn - sampled).max() < 255 / samples / 2


@pytest.mark.parametrize("renderer", ["supersample-16", "warp"])
def test_renderers_agree_on_families_with_data_outside(renderer):
    pytest.importorskip("pyapriltags")
    exact = image("tagCustom48h12", 1234).astype(int)
    other = image("tagCustom48h12", 1234, f'renderer = "{renderer}"\n').astype(int)
    difference = np.abs(exact - other)
    assert difference.mean() < (0.1 if renderer == "supersample-16" else 2)


def faults_of(dictionary, marker_id, extra=""):
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(text_of(dictionary, marker_id, extra))
    return "\n".join(refused.value.faults)


def test_a_dictionary_whose_package_is_missing_is_refused_with_what_to_install(monkeypatch):
    monkeypatch.setattr(tag_families, "library_path", lambda: None)
    monkeypatch.setattr(stag, "library_file", lambda: None)
    for dictionary, extra in (("tagStandard41h12", "pyapriltags"), ("STAG_HD21", "stag-python")):
        assert f"for its codes: pip install 'fiducial-sweep[{extra}]'" in faults_of(dictionary, 1)


@pytest.mark.parametrize(("dictionary", "marker_id", "extra", "named"), [
    ("tagCircle21h7", 38, "", "IDs from 0 to 37, which is what tagCircle21h7 has"),
    ("STAG_HD21", 1, 'renderer = "warp"\n', "exact for STag's markers"),
])
def test_what_a_family_lacks_is_refused(dictionary, marker_id, extra, named):
    assert named in faults_of(dictionary, marker_id, extra)
