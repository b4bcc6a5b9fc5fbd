"""`sweep score`: answers of programs that know nothing of us equal a run; bad files are told."""

import re

import cv2
import numpy as np
import pytest
import xarray as xr

import sweep
from support.answers import TEXT, answer, rows_of, write
from support.blocks import run_cells
from support.stores import by_hand
from sweep import cli
from sweep.errors import ArgumentError, PipelineError, StoreError
from sweep.evaluation.block import compute_block
from sweep.evaluation.inspection import inspect_scene
from sweep.exchange.answers import Conventions
from sweep.exchange.export import export
from sweep.exchange.score import prepare
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline, cell
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins.loading import Recording
from sweep.store.lifecycle import open_store

DICTIONARIES = 'dictionary = ["DICT_4X4_50", "DICT_APRILTAG_36h11"]'
MARKERS = TEXT.replace("[axes]", f"[axes]\n{DICTIONARIES}"), ['window="full"']
OF_BOARD = [
    'window="full"', "distortion=[]", 'dictionary="DICT_4X4_50"', 'solver="iterative"',
    "guarded=false", "size_m=0.03", "distance_m=[0.15, 0.25]", "trial=2",
]
"""Settings of pipelines of boards."""

SHEETS = """[board]
kind = "markers"
markers = [
    { marker_id = 3, x_m = 0.0, y_m = 0.0 },
    { marker_id = 8, x_m = 0.04, y_m = 0.0, z_m = 0.01, tilt_deg = 20 },
    { marker_id = 5, x_m = -0.04, y_m = 0.0, size_m = 0.02, z_m = -0.01, tilt_deg = -30 },
]
"""
TARGETS = {
    "marker": MARKERS, "several planes": (TEXT + SHEETS, OF_BOARD),
    "one plane": (
        TEXT + '[board]\nkind = "grid"\nrows = 2\ncolumns = 3\ngap_m = 0.01\n', OF_BOARD),
}
"""Name -> text and settings of a pipeline."""


def results_of(pipeline):
    """Return the arrays of all scenes of a pipeline by variable."""
    lengths = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return compute_block(pipeline.experiment, Block((0,) * len(lengths), lengths))


@pytest.fixture(scope="module", params=TARGETS)
def exchanged(request, tmp_path_factory):
    """An export with the detections of the program that its README shows, and the run."""
    folder = tmp_path_factory.mktemp("targets") / "export"
    pipeline = Pipeline.from_text(*TARGETS[request.param], name="exchanged")
    export(pipeline, folder)
    answer(folder)
    return folder, results_of(pipeline)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """An export of markers with the detections of that program."""
    folder = tmp_path_factory.mktemp("score") / "export"
    export(Pipeline.from_text(*MARKERS, name="scored"), folder)
    answer(folder)
    return folder


@pytest.fixture(scope="module")
def ran():
    return results_of(Pipeline.from_text(*MARKERS, name="scored"))


def found_rows(folder):
    """Return the rows of the program's answers that name a marker."""
    return [row for row in rows_of(folder / "detections.csv") if row["id"] != "-1"]


def numbers(row, names):
    return [float(row[name]) for name in names]


def test_detections_of_a_plain_opencv_loop_are_scored_as_a_run(exchanged):
    folder, ran = exchanged
    scored = results_of(prepare(folder, [folder / "detections.csv"]).pipeline)
    assert ran.keys() == scored.keys()
    for name, values in ran.items():
        np.testing.assert_array_equal(values, scored[name], err_msg=name)
    assert (ran["detection"] == DetectionStatus.detected).sum() >= 8
    assert (ran["estimate"] == EstimateStatus.solved).sum() >= 8


def test_a_scored_store_is_a_store(exported, tmp_path, capsys):
    """Until its recorded detections were changed or deleted, which `verify` names."""
    store = str(tmp_path / "mine.zarr")
    assert cli.main(["score", str(exported), str(exported / "detections.csv"), "--name", "mine",
                     "--store", store]) == 0
    assert str(sweep.open(store)["detector"].values) == "mine.npz"
    assert cli.main(["verify", store, "--sample", "0"]) == 0
    assert cli.main(["run", store, "--store", store]) == 0
    assert cli.main(["tradeoff", store]) == 2
    assert "the detections of mine.npz were recorded" in capsys.readouterr().err
    pipeline = open_store(store).pipeline
    scene = inspect_scene(cell(pipeline, "tilt_deg=50,trial=2"))
    assert scene.detection is DetectionStatus.detected
    assert [marker for marker, _ in scene.decoded] == [0]
    assert (scene.decoded[0][1] == scene.markers[0]).all()
    (exported / "experiment/mine.npz").unlink()
    assert cli.main(["verify", store]) == 0
    assert re.search(r"not recomputed|mine\.npz", capsys.readouterr().out)
    assert sweep.open(store).detection.sum() > 0
    none, two = np.zeros(0), np.zeros(2)
    wrong = Recording(none, two, two, two, np.zeros((2, 3, 3)), none).content()
    for content, line in ((b"PK no archive", r"mine\.npz"), (wrong, r"the shape \(2, 4, 2\), not")):
        (exported / "experiment/mine.npz").write_bytes(content)
        with pytest.raises(PipelineError, match=line):
            Pipeline.from_text(pipeline.text, folder=exported / "experiment")


def test_settings_that_go_together_with_the_detector_beside_stay(tmp_path):
    chosen = '{ zip = { detector = ["opencv", "opencv"], useAruco3Detection = [false, true] } }'
    export(Pipeline.from_text(f"{TEXT}search = {chosen}"), tmp_path / "out")
    (tmp_path / "none.csv").touch()
    scored = prepare(tmp_path / "out", [tmp_path / "none.csv"], beside=True).pipeline
    assert scored.axis("useAruco3Detection").values == (False, True)


def test_others_conventions_are_turned_into_ours(exported, ran, tmp_path):
    theirs = []
    order = [1, 0, 3, 2]  # TR TL BL BR
    for row in found_rows(exported):
        other = {"image": f"C:\\images\\{row['image'][:-4]}.jpg", "tag_id": f"{row['id']}.0"}
        for k, j in enumerate(order):
            other |= {f"{axis}_{k}": repr(float(row[f"{axis}{j}"]) + 0.5) for axis in "xy"}
        theirs.append(other)
    path = write(tmp_path / "theirs.csv", theirs)
    ready = prepare(exported, [path],
                    conventions=Conventions(0.5, "TR TL BL BR", "right up out"))
    results = results_of(ready.pipeline)
    for name in ("corner_error_px", "estimate", "translation_error_m", "flipped"):
        np.testing.assert_array_equal(ran[name], results[name], err_msg=name)
    assert len(ready.lines) == 1
    wrong = prepare(exported, [path], names=["wrong"]).lines
    assert any('pass --corner-order "TR TL BL BR"' in line for line in wrong)
    assert any("pass --pixel-center 0.5" in line for line in wrong)


@pytest.mark.parametrize("form", ["rvec", "quaternion"])
def test_poses_alone_are_scored_as_they_are(form, exported, tmp_path):
    generator = np.random.default_rng(3)
    rows, shifts, angles = [], [], []
    for truth in rows_of(exported / "truth.csv"):
        rvec, tvec = (np.array(numbers(truth, [f"{kind}{axis}" for axis in "xyz"]))
                      for kind in "rt")
        turn, _ = cv2.Rodrigues(generator.normal(0, 0.01, 3))
        shifts.append(generator.normal(0, 1e-4, 3))
        angles.append(np.linalg.norm(cv2.Rodrigues(turn)[0]))
        # Their marker frame: x right, y down, z into the marker.
        theirs = turn @ cv2.Rodrigues(rvec)[0] @ np.diag([1.0, -1.0, -1.0])
        values = cv2.Rodrigues(theirs)[0].ravel()
        names = ("rx", "ry", "rz")
        if form == "quaternion":
            angle = np.linalg.norm(values)
            values = -np.array([np.cos(angle / 2), *(np.sin(angle / 2) * values / angle)])
            names = ("qw", "qx", "qy", "qz")
        pose = [*values.tolist(), *(tvec + shifts[-1]).tolist()]
        rows.append({"image": truth["image"], "id": int(truth["id"]), **dict(
            zip((*names, "tx", "ty", "tz"), map(repr, pose), strict=True))})
    path = write(tmp_path / "poses.csv", rows)
    ready = prepare(exported, [path], names=[f"poses-{form}"],
                    conventions=Conventions(0.0, "TL TR BR BL", "right,down,in"))
    results = results_of(ready.pipeline)
    assert ready.pipeline.fixed["solver"] == "recorded"
    assert (results["estimate"] == EstimateStatus.solved).all()
    np.testing.assert_allclose(
        results["translation_error_m"].reshape(-1, 3), shifts, atol=1e-9)
    np.testing.assert_allclose(
        np.radians(results["rotation_error_deg"]).ravel(), angles, atol=1e-7)


def test_poses_behind_the_camera_or_far_from_their_corners_are_never_solved(exported, tmp_path):
    rows = found_rows(exported)
    for number, row in enumerate(rows):
        row |= {"rx": 0, "ry": 0, "rz": 0, "tx": 0, "ty": 0, "tz": (-0.2, 0.2)[number % 2]}
        if number % 2:
            row["rx"] = 0.3  # seen from behind
    ready = prepare(exported, [write(tmp_path / "bad.csv", rows)], names=["bad-poses"])
    results = results_of(ready.pipeline)
    assert (results["estimate"] == EstimateStatus.solver_failed).sum() > 5
    assert not (results["estimate"] == EstimateStatus.solved).any()
    assert np.isnan(results["translation_error_m"]).all()


def test_several_programs_and_our_own_detector_are_paired_on_one_axis(exported, ran, tmp_path):
    empty = tmp_path / "nothing.csv"
    empty.write_text("")
    ready = prepare(exported, [exported / "detections.csv", empty], beside=True)
    by_hand(str(tmp_path / "paired.zarr"), ready.pipeline)
    results = sweep.open(tmp_path / "paired.zarr")
    assert results["detector"].values.tolist() == ["opencv", "detections.npz", "nothing.npz"]
    for name in ("opencv", "detections.npz"):
        np.testing.assert_array_equal(
            ran["corner_error_px"], results["corner_error_px"].sel(detector=name))
    assert not (results.detection.sel(detector="nothing.npz") == DetectionStatus.detected).any()
    assert any("nothing in 0 of 24 images, the others searched in vain" in line
               for line in ready.lines)


def test_scenes_that_were_not_exported_are_failed_and_said(exported):
    whole = prepare(exported, [exported / "detections.csv"]).pipeline
    known = run_cells(whole, whole.experiment.all_scenes.indices(np.arange(24)))
    assert not known.failures
    # On another grid, the cells that it shares with the export have the same detections.
    grown = prepare(exported, [exported / "detections.csv"],
                    settings=["trial=4", "distance_m=[0.25, 0.1]"]).pipeline
    found = run_cells(grown, grown.experiment.all_scenes.indices(np.arange(32)))
    assert {failure.scene % 4 for failure in found.failures} == {3}
    assert "not among those that were exported" in found.failures[0].text
    flags, corners = (found.columns[name][0].reshape(2, 2, 2, 4, *rest)
                      for name, rest in (("detection", ()), ("corner_error_px", (4, 2))))
    assert (flags[..., 3] == DetectionStatus.failed).all()
    np.testing.assert_array_equal(
        corners[:, :, ::-1, :3], known.columns["corner_error_px"][0].reshape(2, 2, 2, 3, 4, 2))


GOOD = "image,id,x0,y0,x1,y1,x2,y2,x3,y3\n{0},0,1,2,3,4,5,6,7,8\n"

BAD = {
    "an unknown image": (GOOD.replace("{0}", "frame1.png"), ("line 2: image frame1.png is not "
                         "among the images; expected a name such as 000000-")),
    "a doubled row": (GOOD + "{0},0,1,2,3,4,5,6,7,9\n", "line 3: image {0} has ID 0 twice, here"),
    "other separators": (GOOD.replace(",", "|"), "between commas, semicolons or tabs, image|id"),
    "a cell without end": (GOOD + "x" * 200_000, "line 3: field larger than field limit"),
    "a wide row": (GOOD + "{0},1,1,2,3,4,5,6,7,8,9\n", "line 3: 11 values; expected 10, as the"),
    "NaN": (GOOD.replace(",8", ",nan"), "line 2: y3 = nan: expected a finite number"),
    "a quaternion of length 2": (
        "image,id,qw,qx,qy,qz,tx,ty,tz\n{0},0,2,0,0,0,0,0,1\n", "a quaternion of length 2"),
    "JSON": ('{"image": "{0}", "id": 0}', "line 1: JSON; expected CSV"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_told_in_a_line_and_nothing_is_written(kind, exported, tmp_path, capsys):
    content, expected = BAD[kind]
    name = rows_of(exported / "truth.csv")[0]["image"]
    path = tmp_path / "bad.csv"
    path.write_text(content.replace("{0}", name))
    before = sorted((exported / "experiment").iterdir())
    assert cli.main(["score", str(exported), str(path), "--store", str(tmp_path / "x.zarr")]) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    assert expected.replace("{0}", name) in err
    assert sorted((exported / "experiment").iterdir()) == before
    assert not (tmp_path / "x.zarr").exists()


def test_what_cannot_be_scored_is_refused_in_a_line(exported, tmp_path):
    good = exported / "detections.csv"
    for folder, files, options, error, line in (
        (tmp_path, [good], {}, StoreError, "not an export; make one with `sweep export"),
        (exported, [good, good], {}, ArgumentError, "another name for each file"),
        (exported, [good], {"names": ["../a"]}, ArgumentError, "letters, digits"),
        (exported, [good], {"settings": ["detector=opencv"]}, ArgumentError, "beside=True"),
        (exported, [good], {"doubled": "none"}, ArgumentError, "none: expected refuse or nearest"),
    ):
        with pytest.raises(error, match=line):
            prepare(folder, files, **options)
    prepare(exported, [good], names=["held"])
    other = write(tmp_path / "other.csv", rows_of(good)[:3])
    with pytest.raises(StoreError, match="holds other detections, which a store may refer to"):
        prepare(exported, [other], names=["held"])
    prepare(exported, [other], names=["held"], overwrite=True)
    for wrong in ((7.0,), (0.0, "TL TL BR BL"), (0.0, "TL TR BR BL", "right up in")):
        with pytest.raises(ArgumentError, match="expected"):
            Conventions(*wrong)


CAMERA = np.array([[180, 0, 99.5], [0, 180, 79.5], [0, 0, 1.0]])
"""The camera of boards."""


@pytest.mark.parametrize("exchanged", ["one plane", "several planes"], indirect=True)
def test_poses_of_a_plain_opencv_loop_are_scored_as_those_of_a_run(exchanged, tmp_path):
    folder, ran = exchanged
    places = {(row["image"], row["id"]): row for row in rows_of(folder / "truth.csv")}
    found = {}
    for row in rows_of(folder / "detections.csv"):
        if (row["image"], row["id"]) in places:
            found.setdefault(row["image"], []).append(row)
    corner_names = [f"{axis}{k}" for k in range(4) for axis in "xy"]
    place_names = [f"{axis}{k}_m" for k in range(4) for axis in "XYZ"]
    answers = []
    for image, rows in found.items():
        objects = [numbers(places[image, row["id"]], place_names) for row in rows]
        pixels = [numbers(row, corner_names) for row in rows]
        _, rvec, tvec = cv2.solvePnP(
            np.reshape(objects, (-1, 3)), np.reshape(pixels, (-1, 2)), CAMERA, None,
            flags=cv2.SOLVEPNP_ITERATIVE)
        pose = dict(zip(("rx", "ry", "rz", "tx", "ty", "tz"),
                        map(repr, [*rvec.ravel().tolist(), *tvec.ravel().tolist()]), strict=True))
        answers.append({"image": image, "id": "", **dict.fromkeys(corner_names, ""), **pose})
    write(tmp_path / "poses.csv", answers)
    ready = prepare(folder, [tmp_path / "poses.csv"], names=["poses"])
    assert ready.pipeline.fixed["solver"] == "recorded"
    scored = results_of(ready.pipeline)
    assert (scored["estimate"] == EstimateStatus.solved).all()
    # The places in OpenCV's own frame, by a rotation vector: rounding, and the last step.
    for name in ("translation_error_m", "rotation_error_rad"):
        np.testing.assert_allclose(scored[name], ran[name], atol=2e-7, err_msg=name)
    assert np.nanmax(scored["reprojection_error_px"]) < 1e-9  # the corners are the pose's image


def test_truth_of_a_charuco_has_its_chessboard(tmp_path):
    board = '[board]\nkind = "charuco"\nsquares_x = 4\nsquares_y = 3\nsquare_m = 0.035\n'
    settings = [*OF_BOARD, 'points="chessboard"', "size_m=0.025", "trial=1"]
    export(Pipeline.from_text(TEXT + board, settings, name="charuco"), tmp_path / "out")
    rows = rows_of(tmp_path / "out/truth_chessboard.csv")
    assert len(rows) == 4 * 6
    (truth, *_) = rows_of(tmp_path / "out/truth.csv")
    rvec, tvec = (np.array(numbers(truth, [f"{kind}{axis}" for axis in "xyz"])) for kind in "rt")
    points = np.array([numbers(row, ("X_m", "Y_m", "Z_m")) for row in rows[:6]])
    expected = cv2.projectPoints(points, rvec, tvec, CAMERA, None)[0][:, 0]
    np.testing.assert_allclose(
        [numbers(row, ("x", "y")) for row in rows[:6]], expected, atol=1e-9)
    with xr.open_dataset(tmp_path / "out/truth.nc", engine="scipy") as dataset:
        assert dataset["true_corners_px"].dims[-3:] == ("marker", "corner", "xy")
    path = tmp_path / "none.csv"
    path.write_text("")
    with pytest.raises(PipelineError, match=r"markers beside recorded detections"):
        prepare(tmp_path / "out", [path])
