"""Photographs of a board and their twins: against exact poses, plain OpenCV and the whole board."""

import cv2
import numpy as np
import pytest

import sweep
from support.blocks import run_cells, whole
from support.board_photographs import (
    BOARD,
    POSES,
    SIZE,
    VIEW,
    board,
    camera,
    image,
    marker_poses,
    write_set,
)
from support.board_scenes import BoardPose, board_scene, levels_of
from sweep.analysis import error_statistics
from sweep.errors import ArgumentError, SweepError
from sweep.evaluation.inspection import scene_image
from sweep.experiment.document import document_text
from sweep.experiment.photographs import board_of
from sweep.experiment.pipeline import Pipeline, cell
from sweep.integrity.verification import verify
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped, TruthSource
from sweep.model.calibration import Calibration
from sweep.photographs import cameras
from sweep.photographs import folder as reading
from sweep.photographs.prepare import prepare, record_of, twin_pipeline, unshared_variance


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A store of five photographs, a marker covered in the first, and of one that is blurred."""
    folder = tmp_path_factory.mktemp("photographs")
    shots = write_set(folder)
    first = cv2.imread(str(shots / "shot0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.fillConvexPoly(first, np.int32(np.rint(imaged(board().corners_m[3], *POSES[0]))), 210)
    cv2.imwrite(str(shots / "shot0.png"), first)
    cv2.imwrite(str(shots / "unseen.png"), cv2.GaussianBlur(first, (0, 0), 9))
    results = sweep.photos(
        shots, camera=folder / "camera.json", board=folder / "board.toml",
        settings=['cornerRefinementMethod=["none", "subpix"]'], store=folder / "shots.zarr",
    )
    return folder, results.load()


def imaged(points, turn, shift):
    """Return the images (..., 2) of points (..., 3) of the board at a pose."""
    seen = points @ turn.T + shift
    return seen[..., :2] / seen[..., 2:] * VIEW[:2] + VIEW[2:]


def test_the_truth_is_that_of_the_board_within_its_standard_deviation(made):
    _, results = made
    errors = []
    for number, pose in enumerate(POSES):
        _, position = marker_poses(pose)
        shown = (results.detection[number, :, 0] != DetectionStatus.not_in_photograph).values
        assert (results.truth[number].values[shown] == TruthSource.board_without_this_marker).all()
        for k in np.flatnonzero(shown):
            turn = cv2.Rodrigues(results.true_rvec[number, k].values)[0] @ pose[0].T
            moved = results.true_tvec_m[number, k].values - position[k]
            std = results.truth_std[number, k].values
            errors.append(np.concatenate([cv2.Rodrigues(turn)[0].ravel(), moved]) / std)
    # Errors of neighbouring markers are almost the same: about 30 independent numbers. Their root
    # mean square is within a factor of 2.2 of 1 with error probability below 1e-6.
    assert 1 / 2.2 < np.sqrt(np.mean(np.square(errors))) < 2.2


def test_the_markers_wholly_in_the_frame_count_whether_found_or_not(made):
    _, results = made
    for number, pose in enumerate(POSES):
        pixels = imaged(board().corners_m, *pose)
        inside = ((pixels >= -0.5) & (pixels <= np.array(SIZE) - 0.5)).all(axis=(1, 2))
        counted = results.detection.values[number, :, 0] != DetectionStatus.not_in_photograph
        assert not (counted & ~inside).any()
        # Of a board that is cut, the pose without a marker's corners may be unknown.
        assert (counted == inside).all() or number == len(POSES) - 1
    assert results.detection[0, 3, 0] == DetectionStatus.no_candidate
    assert (results.detection[-1] == DetectionStatus.no_board).all()
    assert not inside.all()  # the last photograph is cut
    assert np.isnan(results.true_tvec_m.values[-1][~inside]).all()


def test_corners_and_poses_are_those_of_a_plain_loop_over_the_files(made):
    folder, results = made
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD["dictionary"]))
    matrix = np.array([[VIEW[0], 0, VIEW[2]], [0, VIEW[1], VIEW[3]], [0, 0, 1]])
    half = BOARD["marker_m"] / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    compared = 0
    for number, name in enumerate(results.photograph.values):
        grey = cv2.imread(str(folder / "shots" / name), cv2.IMREAD_GRAYSCALE)
        for j, method in enumerate((cv2.aruco.CORNER_REFINE_NONE, cv2.aruco.CORNER_REFINE_SUBPIX)):
            parameters = cv2.aruco.DetectorParameters()
            parameters.cornerRefinementMethod = method
            quads, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
            for quad, marker in zip(quads, np.ravel(ids), strict=len(quads) > 0):
                each = results.isel(trial=number, cornerRefinementMethod=j).sel(marker_id=marker)
                if each.detection == DetectionStatus.not_in_photograph:
                    continue
                truth = each.true_rvec.values, each.true_tvec_m.values
                expected = cv2.projectPoints(square, *truth, matrix, None)[0].reshape(4, 2)
                error = quad.reshape(4, 2) - expected
                assert np.allclose(each.corner_error_px, error, atol=1e-3)
                assert each.estimate == EstimateStatus.solved
                _, _, shifts, _ = cv2.solvePnPGeneric(
                    square, quad.reshape(4, 2).astype(float), matrix, None,
                    flags=cv2.SOLVEPNP_IPPE_SQUARE,
                )
                found = each.translation_error_m.values + truth[1]
                nearest = min(np.linalg.norm(found - shift.ravel()) for shift in shifts)
                assert nearest < 1e-4 * found[2]
                compared += 1
    # All but the covered marker and those of the blurred photograph.
    assert compared == (results.detection != DetectionStatus.not_in_photograph).sum() - 2 * 11


def test_a_photograph_is_the_draw_of_every_interval(made):
    _, results = made
    table = error_statistics(results, per="cornerRefinementMethod")
    error = 100 * (results.translation_error_m / results.true_tvec_m).isel(xyz=2)
    for j in range(2):
        each = error.isel(cornerRefinementMethod=j).values
        used = np.isfinite(each) & (results.flipped.values[..., j] == Flipped.not_flipped)
        mean = each[used].mean()
        # The ratio estimator: sums of deviations by photograph (Cochran, 1977, section 3.12).
        sums = np.where(used, each - mean, 0.0).sum(axis=1)
        half = 2.7764451 * np.sqrt(6 / 5 * (sums**2).sum()) / used.sum()  # 5 of 6 with poses
        assert np.isclose(table.range_bias_percent[j], mean)
        assert np.isclose(table.range_bias_percent_high[j] - mean, half, rtol=1e-6)


def test_the_photographs_are_verified_by_their_digests(made):
    folder, _ = made
    report = verify(str(folder / "shots.zarr"), sample=2)
    assert not report.damage
    assert report.sampled in (1, 2)  # drawn with replacement
    name = folder / "shots" / "shot2.png"
    content = name.read_bytes()
    cv2.imwrite(str(name), np.full(SIZE[::-1], 128, np.uint8))
    try:
        assert "shot2.png" in verify(str(folder / "shots.zarr"), sample=2).not_sampled
    finally:
        name.write_bytes(content)


SCENE = {
    "black": 35, "white": 210, "blur_px": {"normal": [0.6, 0.05]}, "noise_grey": 2.0,
    "geometry_px": 0.1, "geometry_length_px": 60.0,
}


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """The pipeline of three photographs; the last shows a part of the board."""
    folder = tmp_path_factory.mktemp("twins")
    shots = write_set(folder, [POSES[0], POSES[1], POSES[-1]])
    return prepare(
        [shots], folder / "camera.json", board=folder / "board.toml", home=folder,
        settings=["cornerRefinementMethod=subpix"],
    ).pipeline


def test_rows_are_those_of_the_photographs_with_their_poses(prepared):
    record = record_of(prepared)
    twins = twin_pipeline(prepared, SCENE, repeats=2)
    columns = run_cells(twins, whole(twins).indices()).columns
    shown = record.shown
    assert not shown.all()
    flags = columns["detection"][0].reshape(2, *shown.shape)
    assert ((flags == DetectionStatus.not_in_photograph) == ~shown).all()
    assert (flags[:, shown] == DetectionStatus.detected).all()
    truth = columns["true_tvec_m"][0].reshape(2, *shown.shape, 3)
    assert np.array_equal(truth[0], truth[1], equal_nan=True)
    assert np.allclose(truth[0][shown], record.translation[shown], rtol=1e-12)
    turn = columns["true_rvec"][0].reshape(2, *shown.shape, 3)[0][shown]
    for vector, rotation in zip(turn, record.rotation[shown], strict=True):
        assert np.allclose(cv2.Rodrigues(vector)[0], rotation, atol=1e-9)
    assert np.abs(columns["corner_error_px"][0].reshape(2, *shown.shape, 4, 2)[:, shown]).max() < 2
    std = columns["truth_std"][0].reshape(2, *shown.shape, 6)
    assert np.allclose(std[0], record.std, rtol=1e-6, equal_nan=True)


def test_what_is_drawn_of_a_photograph_is_the_same_for_all_its_markers(prepared):
    twins = twin_pipeline(prepared, SCENE, repeats=2)
    indices = whole(twins).indices()
    values = twins.experiment.scene_values(indices)
    blur = values["blur_px"].values.reshape(6, -1)
    assert (blur == blur[:, :1]).all()
    assert len(set(blur[:, 0].tolist())) == 6  # other repeats, other draws
    assert len(set(values["noise_key"].values.tolist())) == len(indices[0])
    some = [index[3:9] for index in indices]
    assert np.array_equal(twins.experiment.scene_values(some)["blur_px"].values, blur.ravel()[3:9])


@pytest.mark.parametrize("marker_id", [0, 4])
def test_a_twin_has_the_prints_of_its_board_around_the_marker(prepared, marker_id):
    scene = {"black": 35, "white": 210, "background": 120, "blur_px": 0.6}
    twin = cell(twin_pipeline(prepared, scene), f"trial=0,marker_id={marker_id}")
    record = record_of(prepared)
    turn = record.rotation[0, marker_id]
    corners = board().corners_m[marker_id]
    # The whole board at a pose that has the marker where the twin has it.
    shift = record.translation[0, marker_id] - turn @ corners.mean(axis=0)
    scenes = board_scene(
        board(), {"width_px": SIZE[0], "height_px": SIZE[1],
                  **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), VIEW, strict=True))},
        BoardPose(turn, shift), blur_px=0.6,
    )
    whole = levels_of(scenes, background=120.0, black=35.0, white=210.0)
    around = 1.8 * (corners - corners.mean(axis=0)) + corners.mean(axis=0)  # 2.4 modules wider
    inside = np.zeros(whole.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(imaged(around, turn, shift)).astype(np.int32), 1)
    difference = np.abs(scene_image(twin, whole_frame=True) - whole)[inside > 0]
    assert difference.max() < 1.0  # rounding


def test_only_photographs_have_twins(prepared):
    twins = twin_pipeline(prepared, {})
    for other in (Pipeline.from_dict({"pose": {"distance_m": 1}}), twins):
        with pytest.raises(SweepError, match="expected a store of photographs"):
            twin_pipeline(other, {})
    with pytest.raises(SweepError, match="nothing beside photographs, which have their own poses"):
        Pipeline.from_text(
            twins.to_toml() + "\n[pose]\ndistance_m = 1\n", folder=prepared.folder)


@pytest.mark.parametrize(("most_px", "document"), [
    (0.15, {"kind": "aprilgrid", "tagRows": 2, "tagCols": 3, "tagSize": 0.035, "tagSpacing": 0.3}),
    (0.4, {"kind": "grid", "rows": 2, "columns": 3, "marker_m": 0.035, "gap_m": 0.0105})])
def test_grids_are_where_they_were_printed(most_px, document, tmp_path):
    """A detector's corners are not: outlines join at squares, and blur of light shrinks black."""
    document = {"dictionary": "DICT_APRILTAG_36h11", **document}
    shots, grid = write_set(tmp_path, POSES[:4]), board_of(document, "board")
    (tmp_path / "board.toml").write_text(document_text(document))
    for number, pose in enumerate(POSES[:4]):
        light = (image(pose, number, printed=grid) / 255.0) ** 2.2
        blurred = 255.0 * cv2.GaussianBlur(light, (0, 0), 0.8) ** (1 / 2.2)
        cv2.imwrite(str(shots / f"shot{number}.png"), blurred.astype(np.uint8))
    for view in ("calibrate", tmp_path / "camera.json"):
        found = prepare([shots], view, board=tmp_path / "board.toml", home=tmp_path, overwrite=True)
        assert next(float(line.split()[1]) for line in found.lines if "board: " in line) < most_px
    positions = [grid.corners_m.mean(axis=1) @ turn.T + shift for turn, shift in POSES[:2]]
    assert record_of(found.pipeline).translation[:2] == pytest.approx(np.array(positions), abs=5e-4)


CAMERA = Calibration(*SIZE, *VIEW, (0.1, -0.2, 0.001, -0.001, 0.05), (), ())


def seen(number, rng, sd_px):
    """Return the chessboard's corners in a photograph, with an error."""
    turn, shift = POSES[number]
    points = board().chessboard_m
    exact, *_ = cameras.derivatives(CAMERA, points, turn, np.array(shift))
    pixels = exact + rng.normal(0, sd_px, exact.shape)
    return reading.FoundCorners(points, pixels, np.arange(len(points)))


def test_the_covariance_of_a_calibration_has_opencvs_standard_deviations():
    rng = np.random.default_rng(1)
    made, _ = cameras.calibrate(SIZE, [seen(number, rng, 0.2) for number in range(len(POSES))])
    covariance = cameras.covariance_of(made)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(made.sd, rel=1e-3)
    # Both focal lengths rest on the same depths.
    assert covariance[0, 1] > 0.5 * np.sqrt(covariance[0, 0] * covariance[1, 1])


def test_a_camera_that_does_not_fit_its_photographs_is_refused():
    turned = [seen(number, np.random.default_rng(number), 4.0) for number in range(len(POSES))]
    with pytest.raises(ArgumentError, match="px RMS beside the camera; expected at most"):
        cameras.calibrate(SIZE, turned)


@pytest.mark.parametrize("number", [0, 2])
def test_what_truth_and_estimates_do_not_share_is_that_of_fitted_poses(number):
    """Both poses are fitted to exact corners with a wrong camera, 200 times."""
    rng = np.random.default_rng(2)
    factor = np.diag([0.4, 0.4, 0.3, 0.3, 2e-3, 4e-3, 1e-4, 1e-4, 2e-3])
    factor[1, 0] = 0.35
    turn, shift = POSES[number]
    own = board().corners_m[4]
    centre = own.mean(axis=0)
    own, others = own - centre, board().chessboard_m - centre
    position = turn @ centre + shift
    pixels = [cameras.derivatives(CAMERA, points, turn, position)[0] for points in (own, others)]
    pose = cameras.fit_pose(CAMERA, others, pixels[1], turn, position)
    predicted = np.sqrt(unshared_variance(CAMERA, factor @ factor.T, pose, others, own))
    errors = []
    for _ in range(200):
        numbers = np.array([*VIEW, *CAMERA.distortion]) + factor @ rng.normal(size=9)
        wrong = Calibration(*SIZE, *numbers[:4], tuple(numbers[4:]), (), ())
        alone, truth = (
            cameras.fit_pose(wrong, points, image, turn, position, np.ones(len(points), dtype=bool))
            for points, image in zip((own, others), pixels, strict=True)
        )
        turned = cv2.Rodrigues(alone.rotation @ truth.rotation.T)[0].ravel()
        errors.append([*turned, *(alone.translation - truth.translation)])
    # Six standard deviations of 200 draws each: within four standard errors.
    assert np.std(errors, axis=0) == pytest.approx(predicted, rel=0.2)


def test_a_files_covariance_is_that_of_its_numbers(tmp_path):
    path = tmp_path / "camera.json"
    matrix = np.diag(np.arange(1.0, 10.0)).ravel().tolist()
    path.write_text(camera()[:-1] + f', "covariance_intrinsics": {matrix}}}')
    covariance = cameras.covariance_of(cameras.camera_of_file(str(path), SIZE))
    assert np.diag(covariance).tolist() == list(range(1, 10))
