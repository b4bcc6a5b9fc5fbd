"""A camera as users know it: fields of view, pixel sizes, files of other programs; no silent trap.

Files of OpenCV, ROS, Kalibr and PhotonVision are read to the last digit, or refused.
"""

import json
import math
import tomllib

import cv2
import numpy as np
import pytest
import yaml

import sweep
from support.here import calls_here
from support.stores import by_hand
from sweep.errors import PipelineError, StoreError
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline, cell
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.store.lifecycle import open_store


def pipeline(camera=None, settings=(), **sections):
    return Pipeline.from_dict(
        {"camera": camera or {}, "pose": {"distance_m": 1.0}, **sections}, settings
    )


def view(camera):
    fixed = pipeline(camera).fixed
    return [float(number) for number in intrinsics(*(fixed[name] for name in VIEW_PARAMETERS))]


@pytest.mark.parametrize("width", [640, 1921])
@pytest.mark.parametrize("fov", [1e-3, 60.0, 179.0])
@pytest.mark.parametrize(("name", "across", "along"), [
    ("hfov_deg", "width_px", "height_px"), ("vfov_deg", "height_px", "width_px"),
])
def test_a_field_of_view_reaches_from_edge_to_edge_of_the_frame(name, across, along, fov, width):
    fx, fy, *centre = view({across: width, along: 700, name: fov})
    assert fx == fy == pytest.approx(width / 2 / math.tan(math.radians(fov / 2)), rel=1e-14)
    # The rays through the outer edges of the first and the last pixel.
    middle = centre[name == "vfov_deg"]
    low, high = math.atan((-0.5 - middle) / fx), math.atan((width - 0.5 - middle) / fx)
    assert math.degrees(high - low) == pytest.approx(fov, rel=1e-10)


@pytest.mark.parametrize(("camera", "focal"), [
    ({"width_px": 1280, "height_px": 720}, 4.0 / 4.8 * 1280),
    ({"width_px": 100, "height_px": 100}, 4.0 / 4.8 * 100),
    ({"height_px": 400}, 4.0 / 4.8 * 640), ({"sensor_width_mm": 6.4}, 4.0 / 6.4 * 640),
    ({"sensor_height_mm": 4.8}, 4.0 / 4.8 * 480),
    ({"sensor_height_mm": 2.7, "width_px": 1280, "height_px": 720}, 4.0 / 2.7 * 720),
    ({"focal_length_mm": 8.0, "width_px": 1920, "height_px": 1200}, 8.0 / 4.8 * 1920),
    # A webcam, from corner to corner: 1360 px.
    ({"width_px": 1920, "height_px": 1080, "dfov_deg": 78.0},
     math.hypot(960, 540) / math.tan(math.radians(39))),
    ({"fx_px": 700}, 700.0), ({"pixel_size_um": 3.45, "focal_length_mm": 8.0}, 8.0 / 3.45e-3),
])
def test_pixels_are_square_unless_both_sides_are_given(camera, focal):
    fx, fy, _, _ = view(camera)
    assert [fx, fy] == pytest.approx([focal] * 2, rel=1e-14)
    assert pipeline(camera).facts.camera["square"]


@pytest.mark.parametrize(("camera", "setting", "left"), [
    ({"fx_px": 500, "fy_px": 510}, "hfov_deg=50", {"hfov_deg": 50}),
    ({"hfov_deg": 50}, "fx_px=600", {"fx_px": 600}),
    ({"hfov_deg": 50, "width_px": 1280}, "focal_length_mm=6",
     {"width_px": 1280, "focal_length_mm": 6}),
    ({"focal_length_mm": 8, "sensor_width_mm": 6}, "pixel_size_um=3",
     {"focal_length_mm": 8, "pixel_size_um": 3}),
])
def test_choosing_one_way_to_give_a_camera_drops_the_others(camera, setting, left):
    chosen = pipeline(camera, [setting])
    assert tomllib.loads(chosen.to_toml())["camera"] == left
    assert cell(pipeline(camera), setting).fixed == chosen.fixed


@pytest.mark.parametrize(("sections", "line"), [
    ({"camera": {"cx_px": 640, "cy_px": 360, "fx_px": 500}}, "cx_px = 640: outside the frame of"),
    ({"camera": {"width_px": 1280, "height_px": 720, "cx_px": 320, "fx_px": 500}},
     "cx_px = 320: far from the centre of the frame of 1280 x 720 px; is it that of another frame"),
    ({"camera": {"cx_px": 319.5}, "axes": {"width_px": [640, 1280]}},
     "cx_px = 319.5: far from the centre of the frame of 640 to 1280 x 480 px"),
])
def test_what_may_surprise_of_a_camera_is_told(sections, line):
    told = pipeline(**sections).facts.camera_notes
    assert [each for each in told if line in each], told


def test_a_run_tells_notes_and_a_dataset_has_the_camera(tmp_path, capfd):
    with calls_here():
        execute(pipeline({"hfov_deg": 60, "cx_px": 700}), tmp_path / "s.zarr")
    assert "cx_px = 700: outside the frame" in capfd.readouterr().err
    attributes = sweep.open(tmp_path / "s.zarr").attrs
    assert attributes["camera_notes"].startswith("cx_px = 700: outside the frame")
    fx = 320 / math.tan(math.radians(30))
    assert attributes["camera_fx_px"] == attributes["camera_fy_px"] == pytest.approx(fx)
    assert attributes["nearest_side_px"] == pytest.approx(fx * 0.01)


MATRIX = [[612.34567890123456, 0, 321.123456789], [0, 611.98765432109876, 1 / 3 + 238],
          [0, 0, 1]]
LENS = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 1e-300]
EIGHT = [*LENS, 0.1, 0.2, 0.3]
SD = [0.7, 0.71, 0.3, 0.4, 0.01, 0.02, 1e-4, 2e-4, 0.05]


def of_file(path, settings=(), **keys):
    """The checked pipeline of a camera file; relative paths start beside it."""
    return Pipeline.from_dict(
        {"camera": {"camera_file": path.name, **keys}, "pose": {"side_px": 40}}, settings,
        folder=path.parent,
    )


def refusals(path, **keys):
    with pytest.raises(PipelineError) as refused:
        of_file(path, **keys)
    return str(refused.value).split("\n")


def write(path, text):
    path.write_text(text)
    return path


def opencv_file(path, matrix=MATRIX, lens=LENS, names=("camera_matrix", "distortion_coefficients"),
                size=("image_width", "image_height"), **more):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(size, (640, 480), strict=False):
        storage.write(name, value)
    storage.writeComment("flags: +fix_principal_point")
    for name, value in {names[0]: np.array(matrix), names[1]: np.array([lens]), **more}.items():
        storage.write(name, value)
    storage.release()
    return path


def assert_camera(pipeline, matrix=MATRIX, lens=LENS, size=(640, 480)):
    (fx, _, cx), (_, fy, cy), _ = matrix
    names = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")
    assert [pipeline.fixed[name] for name in names] == [*size, fx, fy, cx, cy, tuple(lens)]


@pytest.mark.parametrize("ending", ["yml", "yaml", "xml", "json"])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_files_of_opencv_are_read_to_the_last_digit(tmp_path, ending, count):
    rng = np.random.default_rng(count)
    matrix = np.diag([*rng.uniform(100, 3000, 2), 1.0])
    matrix[:2, 2] = rng.uniform(100, 400, 2)
    lens = (rng.normal(size=count) * 10.0 ** rng.uniform(-9, 0, count)).tolist()
    path = opencv_file(tmp_path / f"c.{ending}", matrix, lens)
    assert_camera(of_file(path), matrix.tolist(), lens)


@pytest.mark.parametrize("names", [
    ("Camera_Matrix", "Distortion_Coefficients"), ("K", "D"), ("cameraMatrix1", "distCoeffs1"),
    ("mtx", "dist"),
])
def test_names_of_other_programs_are_understood(tmp_path, names):
    single = np.array(MATRIX, dtype=np.float32), np.array(LENS[:4], dtype=np.float32)
    path = opencv_file(tmp_path / "c.yml", *single, names)
    assert_camera(of_file(path), *(each.tolist() for each in single))


def test_a_stereo_pair_has_two_cameras_that_are_named_and_no_frame_size(tmp_path):
    second = np.array(MATRIX) + np.diag([5, 5, 0])
    path = opencv_file(tmp_path / "intrinsics.yml", names=("M1", "D1"), size=(), M2=second,
                       D2=np.array([LENS]))
    line, = refusals(path)
    assert "2 cameras: 1, 2; name one, as in FILE#1" in line
    both = path.with_name("intrinsics.yml#2")
    line, = refusals(both)
    assert "expected width_px and height_px beside it: intrinsics.yml does not say" in line
    assert_camera(of_file(both, width_px=640, height_px=480), second.tolist())


def matrix_of(rows, data):
    numbers = np.ravel(data).tolist()
    return {"rows": rows, "cols": len(numbers) // rows, "data": numbers}


def text_of(**keys):
    """The text of a YAML file, its lists in one line each."""
    return yaml.safe_dump(keys, default_flow_style=None, sort_keys=False, width=10_000)


def ros_text(lens=LENS, matrix=MATRIX):
    return text_of(
        image_width=640, image_height=480, camera_name="narrow_stereo",
        camera_matrix=matrix_of(3, matrix), distortion_model="plumb_bob",
        distortion_coefficients=matrix_of(1, lens), rectification_matrix=matrix_of(3, np.eye(3)),
        projection_matrix=matrix_of(3, [500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]),
    )


GOOD = ros_text()
PRINTED = text_of(
    header={"stamp": {"sec": 1, "nanosec": 2}}, height=480, width=640,
    distortion_model="plumb_bob", d=LENS, k=np.ravel(MATRIX).tolist(), r=np.eye(3).ravel().tolist(),
    p=[500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0], binning_x=0, binning_y=0,
    roi={"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
) + "---\n"
CAM0 = [[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]]
CAM1 = [[457.587, 0, 379.999], [0, 456.134, 255.238], [0, 0, 1]]
KALIBR = text_of(
    cam0={
        "cam_overlaps": [1], "camera_model": "pinhole", "distortion_coeffs": LENS[:4],
        "distortion_model": "radtan", "intrinsics": [458.654, 457.296, 367.215, 248.375],
        "resolution": [752, 480], "rostopic": "/cam0/image_raw",
    },
    cam1={
        "T_cn_cnm1": np.eye(4).tolist(), "camera_model": "pinhole", "distortion_coeffs": [],
        "distortion_model": "none", "intrinsics": [457.587, 456.134, 379.999, 255.238],
        "resolution": [752, 480], "rostopic": "/cam1/image_raw",
    },
)
OPENCV_2 = f"""%YAML:1.0
image_Size: [ 640, 480 ]
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {np.ravel(MATRIX).tolist()}
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: {LENS}
"""


def photonvision(width=1280, height=720):
    return {
        "resolution": {"width": float(width), "height": float(height)},
        "cameraIntrinsics": matrix_of(3, MATRIX) | {"type": 6},
        "distCoeffs": matrix_of(1, EIGHT) | {"type": 6}, "calobjectWarp": [], "observations": [],
        "calobjectSize": {"width": 7.0, "height": 7.0}, "calobjectSpacing": 0.0254,
        "lensmodel": "LENSMODEL_OPENCV",
    }


# Program: the file's content, and what is read; of a camera that is named, with its name.
OTHERS = {
    "ROS": (GOOD, {}),
    "ROS, the whole region": (
        GOOD + "roi: {x_offset: 0, y_offset: 0, width: 640, height: 480}\n" + f"D: {LENS}\n", {}),
    "a printed message": (PRINTED, {}), "OpenCV 2": (OPENCV_2, {}),
    "Kalibr, cam0": (KALIBR, {"matrix": CAM0, "lens": LENS[:4], "size": (752, 480)}),
    "Kalibr, cam1": (KALIBR, {"matrix": CAM1, "lens": (), "size": (752, 480)}),
    "PhotonVision": (json.dumps(photonvision()), {"lens": EIGHT, "size": (1280, 720)}),
    "PhotonVision's settings, 640x480": (json.dumps({
        "nickname": "front", "calibrations": [photonvision(), photonvision(640, 480)],
    }), {"lens": EIGHT}),
}


@pytest.mark.parametrize("name", OTHERS)
def test_files_of_other_programs_are_read(tmp_path, name):
    content, expected = OTHERS[name]
    path = write(tmp_path / "c.any", content)
    _, named, one = name.partition(", ")
    chosen = of_file(path.with_name(f"c.any#{one}") if named and " " not in one else path)
    assert_camera(chosen, **expected)


def damaged(text, old, new):
    assert old in text
    return text.replace(old, new)


REFUSED = {
    "cut short": (GOOD[: GOOD.index("distortion_model") - 30], "cut short"),
    "no lens": (GOOD[: GOOD.index("distortion_coeff")], "no distortion coefficients"),
    "empty": ("", "empty"),
    "zeros": (ros_text(matrix=np.zeros((3, 3))), "a matrix of zeros: the camera was not"),
    "singular": (damaged(GOOD, repr(MATRIX[1][1]), "0"), "focal lengths 612.346 and 0; expected"),
    "skew": (ros_text(matrix=[[600, 0.1, 320], [0, 600, 240], [0, 0, 1]]),
             "a skew of 0.1 is not supported"),
    "three coefficients": (ros_text(lens=[0.1, 0.2, 0.3]), "3 coefficients; expected 0 or 4 or 5"),
    "omni, cam0": (damaged(KALIBR, "pinhole", "omni"), "camera model omni: not supported"),
    "fisheye": (GOOD + "fisheye_model: 1\n", "a fisheye model: not supported"),
    "no size": (damaged(damaged(GOOD, "image_width", "a"), "image_height", "b"),
                "expected width_px and height_px beside it: c.any does not say which frame size"),
    "no width": (damaged(GOOD, "image_width: ", "image_width: [] #"), "[]; expected whole pixels"),
    "empty rows": (damaged(GOOD, "rows: 3", "rows: []"), "3, but 9 numbers; is it cut short?"),
    "twice": (GOOD + "image_width: 800\n", "it has the key image_width twice"),
    "a tag": ("!!python/object/apply:os.system ['true']\n", "not a camera file"),
    "billion laughs": (
        "a: &a [1,1]\n" + "".join(
            f"{y}: &{y} [*{x},*{x}]\n" for x, y in zip("abcdefghi", "bcdefghij", strict=True)
        ), "not a camera file"),
    "deep JSON": ('{"a":' + "[" * 100_000, "nested too deeply"),
    "huge": ("#" * 4_000_001, "expected at most 4,000,000 bytes"),
    "deviations below 0": (GOOD + f"std_deviations_intrinsics: {[-1] * 9}\n", "below 0"),
    "two matrices": (GOOD + "K: [600, 0, 320, 0, 600, 240, 0, 0, 1]\n",
                     "camera_matrix and K differ: delete one of them"),
    "a region of the frame": (GOOD + "roi: {x_offset: 0, width: 320, height: 240}\n",
                              "roi with height = 240: the matrix is that of the whole frame"),
    "binning": (damaged(PRINTED, "binning_x: 0", "binning_x: 2"),
                "binning_x = 2: the matrix is that of the frame without binning"),
    "two cameras": (KALIBR, "2 cameras: cam0, cam1; name one, as in FILE#cam0"),
    "another camera, cam2": (KALIBR, "no camera cam2; did you mean cam"),
    "focal length out of range": (damaged(GOOD, repr(MATRIX[0][0]), "1e12"),
                                  "fx_px = 1000000000000.0: expected a number from 0.001"),
    "no file": (None, "(No such file or directory)"), "a folder": (False, "(Is a directory)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_is_no_camera_s_is_refused_in_one_line(tmp_path, case, capfd):
    content, expected = REFUSED[case]
    path = tmp_path / "c.any"
    if content is False:
        path.mkdir()
    elif content is not None:
        path.write_text(content)
    if "cam" in case.partition(", ")[2]:
        path = path.with_name(f"c.any#{case.partition(', ')[2]}")
    line, = refusals(path)
    assert line.startswith(f'pipeline: camera.camera_file = "{path.name}": expected ')
    assert expected in line
    assert len(line) < 500
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("keys", "lines"), [
    ({"width_px": 1280},
     ["width_px = 1280: expected 640, which c.yaml has; delete it, or camera_file"]),
    ({"fx_px": 600, "cx_px": 3},
     ["fx_px = 600: expected 612.3456789012346, which c.yaml has; delete it, or camera_file",
      "cx_px = 3: expected 321.123456789, which c.yaml has; delete it, or camera_file"]),
    ({"distortion": []}, ["distortion = []: expected [-0.28340811"]),
    ({"sensor_width_mm": 6, "focal_length_mm": 3},
     ["sensor_width_mm = 6: expected no other camera beside camera_file",
      "focal_length_mm = 3: expected no other camera beside camera_file"]),
])
def test_other_keys_of_the_camera_beside_a_file_are_refused(tmp_path, keys, lines):
    told = refusals(write(tmp_path / "c.yaml", GOOD), **keys)
    assert len(told) == len(lines)
    assert all([line for line in told if expected in line] for expected in lines), told


@pytest.mark.parametrize(("ending", "name"), [
    ("yml", "std_deviations_intrinsics"), ("xml", "stdDeviationsIntrinsics"),
    ("json", "covariance_intrinsics"),
])
def test_what_opencv_s_calibration_says_of_its_errors_is_believed(tmp_path, ending, name):
    # OpenCV writes 18 deviations, zeros for what was not estimated.
    matrix = np.diag(np.square(SD))
    matrix[0, 1] = matrix[1, 0] = 0.9 * SD[0] * SD[1]
    known = matrix if name.startswith("cov") else np.array([*SD, *[0.0] * 9])[:, None]
    chosen = of_file(
        opencv_file(tmp_path / f"c.{ending}", **{name: known}), ["believed=calibration"])
    key = "calibration_covariance" if name.startswith("cov") else "calibration_sd"
    assert chosen.fixed[key] == (tuple(matrix.ravel().tolist()) if known is matrix else tuple(SD))
    assert Pipeline.from_text(chosen.to_toml(), folder=tmp_path) == chosen
    assert key in chosen.to_toml()
    plain = opencv_file(tmp_path / f"plain.{ending}")
    with pytest.raises(PipelineError, match=r"give calibration_sd under .* \(camera_file has"):
        of_file(plain, ["believed=calibration"])
    given = of_file(plain, ["believed=calibration"], calibration_sd=SD)
    assert given.fixed["calibration_sd"] == tuple(SD)


def test_the_text_of_a_pipeline_has_the_values_of_its_camera_file(tmp_path):
    path = write(tmp_path / "c.yaml", GOOD)
    chosen = of_file(path)
    path.unlink()
    assert Pipeline.from_text(chosen.to_toml(), folder=tmp_path) == chosen
    assert cell(chosen, "side_px=30").fixed["fx_px"] == MATRIX[0][0]
    wider = cell(chosen, "hfov_deg=90")
    assert (wider.fixed["fx_px"], wider.fixed["cx_px"]) == (None, MATRIX[0][2])
    other = Pipeline.from_text(chosen.to_toml(), ["fx_px=700"])
    assert (other.fixed["camera_file"], other.fixed["fx_px"]) == (None, 700)
    assert other.fixed["distortion"] == tuple(LENS)


def test_set_of_a_camera_file_replaces_the_camera_and_keeps_comments(tmp_path):
    write(tmp_path / "c.yaml", GOOD)
    write(tmp_path / "p.toml", "[camera]  # mine\nfocal_length_mm = 6\nwidth_px = 99\n"
          "[pose]\nside_px = 30\n")
    chosen = Pipeline.from_toml(tmp_path / "p.toml", ["camera_file=c.yaml"])
    assert_camera(chosen)
    assert "[camera]  # mine" in chosen.to_toml()
    assert "focal_length_mm" not in chosen.to_toml()


def test_a_store_does_not_need_its_camera_file_any_more(tmp_path):
    url, rest = str(tmp_path / "s.zarr"), {"marker": {"size_m": 0.05}, "axes": {
        "distance_m": [0.5, 0.8]}}

    def of(name):
        return Pipeline.from_dict({"camera": {"camera_file": name}, **rest}, folder=tmp_path)

    by_hand(url, of(write(tmp_path / "c.yaml", GOOD).name))
    (tmp_path / "c.yaml").rename(tmp_path / "moved.yaml")
    assert_camera(open_store(url).pipeline)
    # The file elsewhere has the same content: the run is finished.
    assert execute(of("moved.yaml"), url).computed_blocks == 0
    write(tmp_path / "c.yaml", GOOD.replace(repr(MATRIX[0][0]), "700.0"))
    with pytest.raises(StoreError, match=r"fx_px: the store has 612\.345\d+, this run 700\.0"):
        execute(of("c.yaml"), url)
