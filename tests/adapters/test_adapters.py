"""The adapters of other packages' detectors, Locus' solver, and markers of their own families.

References are the packages themselves; tests skip where one is missing.
"""

import ctypes
import importlib.metadata
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest

import sweep
from support.blocks import run_cells
from support.here import Here
from sweep import Pipeline, PipelineError
from sweep.conformance.check import check_plugin
from sweep.evaluation.inspection import scene_image
from sweep.experiment.pipeline import cell
from sweep.isolation.child_process import Child
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model import marker as families
from sweep.model.marker import marker_count, module_count, modules, overhang
from sweep.plugins.loading import load

MODULES = {
    "pyapriltags": "pyapriltags", "pupil-apriltags": "pupil_apriltags",
    "robotpy-apriltag": "robotpy_apriltag", "locus-tag": "locus", "stag-python": "stag",
}


PLUGINS, LOCUS = Path(__file__).parents[2] / "pipelines" / "plugins", "locus_board:SOLVER"


def refusal(document, *settings):
    """The faults of a document, one a line."""
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_dict(document, settings, folder=PLUGINS)
    return "\n".join(refused.value.faults)


@pytest.fixture(params=MODULES)
def detector(request):
    pytest.importorskip(MODULES[request.param])
    return request.param


RUN = {
    "seed": 4, "camera": {"width_px": 320, "height_px": 240, "fx_px": 500.0},
    "marker": {"dictionary": "DICT_APRILTAG_36h11", "size_m": 0.1},
    "pose": {"side_px": 70, "jitter_px": 0.5, "roll_deg": 30}, "scene": {"noise_grey": 2},
    "axes": {"tilt_deg": [0, 35], "detector": ["opencv", "pyapriltags"], "trial": 4},
}


def test_an_adapter_conforms(detector):
    # Images of few pixels, which are tried too, leave pupil-apriltags' heap corrupted: the process
    # may die when it ends.
    child = Child if detector == "pupil-apriltags" else Here
    with mock.patch("sweep.conformance.check.Child", child):
        report = check_plugin(detector)
    assert report.attrs["conforms"], report
    assert max(map(abs, report.attrs["offset_px"])) < 0.02


@pytest.mark.evidence
def test_all_families_of_an_adapter_come_in_our_order(detector):
    for family in load("detector", detector, ".")[0].families:
        if family in ("tagCircle49h12", "tagCustom48h12", "tagStandard52h13"):
            continue  # seconds and gigabytes each
        with mock.patch("sweep.conformance.check.Child", Here):
            report = check_plugin(detector, family)
        assert report.attrs["conforms"], (family, report)


def test_a_run_is_a_plain_loop_with_the_package(tmp_path):
    package = pytest.importorskip("pyapriltags")
    pipeline = Pipeline.from_dict(RUN, ["quad_decimate=1"])
    results = sweep.run(pipeline, store=str(tmp_path / "run.zarr")).load()
    plain = package.Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    square = 0.05 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=float)
    camera = np.array([[500, 0, 159.5], [0, 500, 119.5], [0, 0, 1.0]])
    for tilt, trial in np.ndindex(2, 4):
        single = cell(pipeline, f"tilt_deg={35 * tilt},trial={trial},detector=pyapriltags")
        (tag,) = plain.detect(np.ascontiguousarray(scene_image(single, whole_frame=True)))
        here = results.isel(tilt_deg=tilt, trial=trial)
        truth, _ = cv2.projectPoints(
            square, here.true_rvec.values, here.true_tvec_m.values, camera, None)
        # AprilTag's corners are TR, TL, BL, BR of OpenCV's marker, pixel centres at 0.5.
        error = np.asarray(tag.corners)[[1, 0, 3, 2]] - 0.5 - truth[:, 0]
        opencv, ours = here.corner_error_px.transpose("detector", ...).values
        assert np.abs(ours - error).max() < 1e-6
        assert np.abs(opencv).max() < 2


def test_a_missing_package_is_told_with_its_command(monkeypatch):
    if not importlib.metadata.entry_points(group="sweep.detectors", name="locus-tag"):
        pytest.skip("installed before there were adapters")
    missing = mock.Mock(side_effect=importlib.metadata.PackageNotFoundError("locus-tag"))
    monkeypatch.setattr(importlib.metadata, "version", missing)
    monkeypatch.setattr(families, "library_path", lambda: None)
    monkeypatch.setattr(families, "library_file", lambda: None)
    for settings, extra in (*(([f"detector=['{name}']"], name) for name in MODULES),
                            (["dictionary=tagStandard41h12"], "pyapriltags"),
                            (["dictionary=STAG_HD21"], "stag-python")):
        told = refusal(RUN | {"axes": {"trial": 4}}, *settings)
        assert f"pip install 'fiducial-sweep[{extra}]'" in told


GRID = {"kind": "grid", "rows": 3, "columns": 4, "gap_m": 0.02}
CHARUCO = {"kind": "charuco", "squares_x": 5, "squares_y": 4, "square_m": 0.065,
           "legacy_pattern": True}


def board_document(board, solver=LOCUS, **marker):
    return {
        "seed": 5, "camera": {"width_px": 640, "height_px": 480, "fx_px": 700},
        "marker": {"dictionary": "DICT_APRILTAG_36h11", "size_m": 0.05, "quiet_zone_modules": 1,
                   **marker},
        "board": board, "scene": {"blur_px": 0.5}, "estimator": {"solver": solver},
        "pose": {"distance_m": 0.5, "tilt_deg": 30, "azimuth_deg": {"uniform": [0, 360]},
                 "jitter_px": 20},
        "axes": {"trial": 4},
    }


def test_a_detectors_markers_make_the_boards_pose(detector):
    if detector == "stag-python":
        pytest.skip("it has no markers of boards")
    settings = [f"detector='{detector}'", "tilt_deg=20", "distance_m=0.4"]
    settings += ["min_cluster_pixels=5"] if detector == "robotpy-apriltag" else []
    results = run_cells(
        Pipeline.from_dict(board_document(GRID, "sqpnp"), settings), [np.arange(4)]).columns
    assert (results["marker_detection"][0] == DetectionStatus.detected).mean() > 0.9
    assert (results["estimate"][0] == EstimateStatus.solved).all()
    # A corner is off by less than 0.2 px at 1750 px/m: 0.1 mm over a board of 27 cm.
    assert results["rotation_error_deg"][0].max() < 0.3


@pytest.mark.parametrize(("board", "settings"), [
    (GRID, []), (GRID, ["detector='locus-tag'"]), (CHARUCO, []),
    (CHARUCO, ["locus_chessboard=false"]),
], ids=["grid", "grid, own detector", "charuco", "markers of a charuco"])
def test_locus_own_estimator_gives_the_boards_pose_and_covariance(board, settings):
    pytest.importorskip("locus")
    pipeline = Pipeline.from_dict(board_document(board), settings, folder=PLUGINS)
    results = run_cells(pipeline, [np.arange(4)]).columns
    assert (results["estimate"][0] == EstimateStatus.solved).all()
    assert results["rotation_error_deg"][0].max() < 0.3
    assert np.abs(results["translation_error_m"][0]).max() < 1e-3
    assert np.isfinite(results["nees"][0]).all()


@pytest.mark.parametrize(("settings", "expected"), [
    (["legacy_pattern=false"], "legacy_pattern = true and an even number"),
    (["squares_y=3"], "legacy_pattern = true and an even number"),
    (["marker_id=3"], "expected marker_id 0"),
    (["distortion=[-0.1, 0, 0, 0]"], "built without lenses"),
])
def test_boards_that_locus_lacks_are_failures_that_say_why(settings, expected):
    pytest.importorskip("locus")
    pipeline = Pipeline.from_dict(board_document(CHARUCO), settings, folder=PLUGINS)
    results = run_cells(pipeline, [np.arange(1)])
    assert (results.columns["estimate"][0] == EstimateStatus.failed).all()
    assert expected in results.failures[0].text


def family_document(dictionary, marker_id, **scene):
    detector = "stag-python" if dictionary.startswith("STAG") else "pyapriltags"
    return {
        "camera": {"width_px": 320, "height_px": 240, "fx_px": 600.0, "fy_px": 600.0},
        "marker": {"dictionary": dictionary, "marker_id": marker_id},
        "pose": {"side_px": 90, "tilt_deg": 25, "azimuth_deg": 70, "roll_deg": 140},
        "detector": {"detector": detector}, "scene": {"background": 90, **scene},
    }


def image(*of, settings=(), **scene):
    pipeline = Pipeline.from_dict(family_document(*of, **scene), settings)
    return np.ascontiguousarray(scene_image(pipeline, whole_frame=True))


class AprilTagImage(ctypes.Structure):
    _fields_ = (
        ("width", ctypes.c_int), ("height", ctypes.c_int), ("stride", ctypes.c_int),
        ("buf", ctypes.POINTER(ctypes.c_uint8)),
    )


@pytest.mark.parametrize("family", families.TAG_FAMILIES)
def test_modules_of_tag_families_are_those_that_apriltag_draws(family):
    pyapriltags = pytest.importorskip("pyapriltags")
    library = ctypes.CDLL(str(Path(pyapriltags.__file__).parent / "libapriltag.so"))
    create = getattr(library, f"{family}_create")
    create.restype = ctypes.c_void_p
    library.apriltag_to_image.restype = ctypes.POINTER(AprilTagImage)
    library.apriltag_to_image.argtypes = (ctypes.c_void_p, ctypes.c_uint32)
    made = create()
    _, positions = families._codes(family)
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


@pytest.mark.parametrize("library", families.STAG_LIBRARIES)
def test_stag_reads_the_markers_that_are_drawn(library):
    package = pytest.importorskip("stag")
    last = marker_count(library) - 1
    for marker_id in sorted({0, last // 2, last}):
        _, ids, _ = package.detectMarkers(image(library, marker_id), int(library[-2:]))
        assert np.ravel(ids).tolist() == [marker_id]


def test_stag_image_is_that_of_many_samples():
    pytest.importorskip("stag")
    drawn = image("STAG_HD19", 7, settings=["tilt_deg=0", "roll_deg=0"])[60:180, 100:220]
    # 20 samples along a side of a pixel, each black or white by the distances to the circles.
    samples = (np.arange(120 * 20) + 0.5) / 20 - 0.5
    x, y = np.meshgrid((samples - 59.5) / 90 * families.STAG_MODULES + 4,
                       (samples - 59.5) / 90 * families.STAG_MODULES + 4)
    across = np.maximum(np.abs(x - 4), np.abs(y - 4))
    level = np.where(across <= 5, 255.0, 90.0)
    level[across <= 4] = 0
    level[np.hypot(x - 4, y - 4) <= families.CIRCLE_RADIUS] = 255
    code = int(families._stag_codes("STAG_HD19")[7])
    for bit, (centre_x, centre_y) in enumerate(families.dot_centres()):
        if code >> bit & 1:
            level[np.hypot(x - centre_x, y - centre_y) <= families.DOT_RADIUS] = 0
    sampled = level.reshape(120, 20, 120, 20).mean(axis=(1, 3))
    assert np.abs(drawn - sampled).max() < 255 / 20 / 2


@pytest.mark.parametrize(("renderer", "most"), [("supersample-16", 0.1), ("warp", 2)])
def test_renderers_agree_on_families_with_data_outside(renderer, most):
    pytest.importorskip("pyapriltags")
    exact, other = (image("tagCustom48h12", 1234, renderer=each).astype(int)
                    for each in ("exact", renderer))
    assert np.abs(exact - other).mean() < most


CIRCLE, WARPED = ("tagCircle21h7", 38), ("STAG_HD21", 1)


@pytest.mark.parametrize(("document", "settings", "named"), [
    (board_document(GRID), ["points='each_marker'"],
     f"markers beside solver = {LOCUS}, which chooses by"),
    (board_document(GRID), ["refine='lm'"],
     f"none beside solver = {LOCUS}, which chooses by itself"),
    (board_document({}), [], "a solver of single markers, or a board: give kind under [board]"),
    (family_document(*CIRCLE), [], "IDs from 0 to 37, which is what tagCircle21h7 has"),
    (family_document(*WARPED), ["renderer=warp"], "exact for STag's markers"),
])
def test_what_a_solver_or_a_family_lacks_is_refused_in_a_line(document, settings, named):
    pytest.importorskip("locus")
    told = refusal(document, *settings)
    assert named in told
    assert "\n" not in told
