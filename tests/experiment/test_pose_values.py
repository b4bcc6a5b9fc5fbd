"""Ways of giving a pose: each against SciPy's Rotation and closed forms, and all against draws."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.blocks import whole
from support.documents import LENS, any_document
from support.lengths import first_of, lengths
from sweep.evaluation.search import visibility_flags
from sweep.evaluation.variables import GEOMETRY
from sweep.experiment.parameters import WORLD
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus
from sweep.model.marker import module_count
from sweep.model.scene import build_scenes

FLIP = np.diag([1.0, -1.0, -1.0])
SCIPY = "SciPy's `Rotation`"

def made(pose, axes=None, seed=1, **sections):
    """Return the values and scenes of a pipeline's whole grid."""
    pipeline = Pipeline.from_dict({"seed": seed, "pose": pose, "axes": axes or {}, **sections})
    block = whole(pipeline)
    values = pipeline.experiment.scene_values(block.indices())
    return values, build_scenes(values, len(block))


def drawn(pose, count):
    """Return as :func:`made`, of ``count`` draws from ranges (low, high) by name."""
    return made({name: {"uniform": list(ends)} for name, ends in pose.items()}, {"trial": count})


@lengths(1000, 100_000)
def test_yaw_pitch_and_roll_are_scipys(count, claim):
    turns = [*range(-180, 181, 15), 1e-9, 89.9]
    names = [f"{name}_deg" for name in ("yaw", "pitch", "roll")]
    worst = 0.0
    for values, scenes in (
        made({"distance_m": 1}, dict.fromkeys(names, turns)),
        drawn({"distance_m": (1, 2), **dict.fromkeys(names, (-180, 180))}, count),
    ):
        angles = np.stack([values[name].broadcast(len(scenes)) for name in names], axis=1)
        expected = Rotation.from_euler("YXZ", angles, degrees=True).as_matrix() @ FLIP
        worst = max(worst, np.abs(scenes.rotation - expected).max())
    claim("rotations by yaw, pitch and roll, 10^5", SCIPY, worst, "of an element")
    assert worst < 1e-14


def outline(scenes, quiet_modules, points):
    """Return points (N, M, 3) along the sides of the quiet zone, in the marker's frame."""
    modules = module_count(scenes.dictionary[0])
    half = scenes.size_m / 2 * (1 + 2 * quiet_modules / modules)
    t = np.linspace(-1, 1, points)
    one = np.ones_like(t)
    sides = [np.stack(side, axis=1) for side in ((t, one), (t, -one), (one, t), (-one, t))]
    square = np.column_stack([np.concatenate(sides), np.zeros(4 * points)])
    return half[:, None, None] * square


def projected(scenes, points, distortion):
    """Return their pixels by ``cv2.projectPoints``."""
    pixels = []
    for k in range(len(scenes)):
        rvec = Rotation.from_matrix(scenes.rotation[k]).as_rotvec()
        image, _ = cv2.projectPoints(
            points[k], rvec, scenes.translation[k], scenes.cameras.matrix(k),
            np.array(distortion, float) if distortion else None,
        )
        pixels.append(image[:, 0])
    return np.array(pixels)


@pytest.mark.parametrize("distortion", [[], LENS, [0.25, 0.1, 0, 0]])
@pytest.mark.parametrize("turn", first_of(["tilt_deg", "view_angle_deg", "yaw_deg"], 1))
@lengths(200, 5000)
def test_share_of_the_frame_never_leaves_it_and_reaches_its_edges(distortion, turn, count):
    """No scene may be outside; that 200 leave a tenth empty has a chance below 0.9^200 = 7e-10."""
    values, scenes = made(
        {"frame_x": {"uniform": [0, 1]}, "frame_y": {"uniform": [0, 1]},
         "distance_m": {"uniform": [0.5, 4]}, turn: {"uniform": [-75, 75]},
         "roll_deg": {"uniform": [0, 360]}, "jitter_px": 2},
        {"trial": count}, marker={"size_m": 0.1, "quiet_zone_modules": 2},
        camera={"fx_px": 500, "distortion": distortion},
    )
    pixels = projected(scenes, outline(scenes, 2, 50), distortion)
    assert (pixels > -0.5 - 1e-6).all()
    assert (pixels < np.array([639.5, 479.5]) + 1e-6).all()
    for axis, (name, length) in enumerate((("frame_x", 640), ("frame_y", 480))):
        share = values[name].values
        low, high = pixels[:, :, axis].min(axis=1), pixels[:, :, axis].max(axis=1)
        # The free space before the marker is to all free space as the share, but for jitter and,
        # as that is measured in pixels here, perspective.
        free = (low + 0.5) / (length - 1 - (high - low) + 1)
        assert np.abs(free - share).max() < 0.12
        assert free.min() < 0.1
        assert free.max() > 0.9


@pytest.mark.parametrize("distortion", [[], LENS])
def test_shares_of_0_and_1_touch_the_edges(distortion):
    for share, edge, end in ((0, -0.5, np.min), (1, np.array([639.5, 479.5]), np.max)):
        _, scenes = made(
            {"frame_x": share, "frame_y": share, "distance_m": 1},
            {"view_angle_deg": [0, 60], "azimuth_deg": [0, 200]}, marker={"size_m": 0.1},
            camera={"fx_px": 500, "distortion": distortion},
        )
        pixels = projected(scenes, outline(scenes, 1, 50), distortion)
        # Under a lens, 0.05 px are kept free.
        tolerance = 0.06 if distortion else 1e-9
        np.testing.assert_allclose(
            end(pixels, axis=1), np.broadcast_to(edge, (4, 2)), atol=tolerance
        )


def test_a_lens_that_folds_before_the_edges_keeps_left_and_right_alike():
    # r (1 - 0.8 r²) grows up to r = 0.645, which is 215 px of 320 from the middle.
    _, scenes = made({"frame_y": 0.5, "distance_m": 1}, {"frame_x": [0, 1]},
                     marker={"size_m": 0.1}, camera={"fx_px": 500, "distortion": [-0.8, 0, 0, 0]})
    left, right = scenes.corners_px[:, :, 0]
    np.testing.assert_allclose(np.sort(639 - left), np.sort(right), atol=1e-6)
    assert left.min() == pytest.approx(319.5 - 500 * 0.645 * 2 / 3, abs=1)


@lengths(1000, 100_000)
def test_places_in_the_world_are_scipys(count, claim):
    wholes = [made({}, {
        "camera_x_m": [0, -3], "camera_y_m": [1], "camera_z_m": [0.5, 1000], "camera_yaw_deg": [20],
        "camera_pitch_deg": [-10, 90], "camera_roll_deg": [5], "marker_x_m": [2, -2],
        "marker_z_m": [0.2], "marker_yaw_deg": [180, 30], "marker_pitch_deg": [-90, 0, 12],
        "marker_roll_deg": [0, 40],
    }), drawn({name: (-100, 100) if name.endswith("_m") else (-180, 180) for name in WORLD}, count)]
    image = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    face = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    worst = np.zeros(2)
    for values, scenes in wholes:
        of = {name: np.zeros(len(scenes)) if values[name].missing
              else values[name].broadcast(len(scenes)) for name in WORLD}

        def part(whose, of=of):
            place = np.stack([of[f"{whose}_{axis}_m"] for axis in "xyz"], axis=1)
            angles = [of[f"{whose}_{name}_deg"] for name in ("yaw", "pitch", "roll")]
            return place, Rotation.from_euler("ZYX", np.stack(angles, axis=1), degrees=True)

        (camera, body), (marker, other) = part("camera"), part("marker")
        turned = (image * body.inv() * other * face).as_matrix()
        moved = image.apply(body.inv().apply(marker - camera))
        worst = np.maximum(worst, [np.abs(scenes.rotation - turned).max(),
                                   np.abs(scenes.translation - moved).max()])
    claim("rotations in the world, 10^5", SCIPY, worst[0], "of an element")
    claim("positions in the world, up to 1 km, 10^5", SCIPY, worst[1], "m")
    assert (worst < [1e-14, 1e-12]).all()


@lengths(20, 2000)
def test_any_pose_has_a_truth_and_is_the_same_alone(count):
    rng = np.random.default_rng(0)
    for _ in range(count):
        document = any_document(rng)
        pipeline = Pipeline.from_dict(document)
        indices, scene_count = whole(pipeline).indices(), len(whole(pipeline))
        values = pipeline.experiment.scene_values(indices)
        scenes = build_scenes(values, scene_count)
        unseen = visibility_flags(scenes, 0) == DetectionStatus.not_visible
        for name, function in GEOMETRY.items():
            numbers = function(scenes)
            if name == "marker_area_px":
                numbers = numbers[~unseen]
            assert np.isfinite(numbers).all(), (name, document)
        if "view_angle_deg" in pipeline.given:
            given = np.abs(values["view_angle_deg"].broadcast(scene_count))
            found = GEOMETRY["viewing_angle_deg"](scenes)
            np.testing.assert_allclose(found, given, atol=1e-10, err_msg=str(document))
        one = int(rng.integers(scene_count))
        alone = build_scenes(
            pipeline.experiment.scene_values([each[one : one + 1] for each in indices]), 1)
        np.testing.assert_array_equal(alone.translation[0], scenes.translation[one])
        np.testing.assert_array_equal(alone.rotation[0], scenes.rotation[one])


def key_draws(pose, axes=None, **sections):
    values, _ = made({"jitter_px": 0.5, **pose}, {**(axes or {}), "trial": 3}, **sections)
    return values["shift_u_px"].values


@pytest.mark.parametrize(
    ("given", "same"),
    [({"yaw_deg": 30}, {"tilt_deg": 30, "azimuth_deg": 90}),
     ({"pitch_deg": 30, "roll_deg": 10}, {"tilt_deg": 30, "roll_deg": 10}),
     ({"yaw_deg": 0, "pitch_deg": 0}, {}),
     ({"view_angle_deg": 40, "azimuth_deg": 20}, {"tilt_deg": 40, "azimuth_deg": 20}),
     ({"view_angle_deg": 0, "roll_deg": 7}, {"roll_deg": 7}),
     ({"x_m": 0.5}, {"bearing_x_deg": 45}), ({"x_m": 0, "y_m": 0}, {}),
     ({"frame_x": 0.5, "frame_y": 0.5}, {}), ({"side_px": 4 / 4.8 * 640 * 0.01 / 0.5}, {}),
     ({"camera_z_m": 0.5, "camera_pitch_deg": 90, "marker_yaw_deg": 180, "marker_pitch_deg": -90},
      {})],
)
def test_a_fixed_pose_has_the_same_draws_in_whichever_way_it_is_given(given, same):
    place = {"distance_m": 0.5}
    if not given.keys().isdisjoint(("side_px", "camera_z_m")):
        np.testing.assert_array_equal(key_draws(given), key_draws(place))
        return
    np.testing.assert_array_equal(key_draws(place | given), key_draws(place | same))
    assert (key_draws(place | given) != key_draws({"distance_m": 0.6} | given)).all()


def test_places_in_metres_are_the_truth():
    values, scenes = made(
        {}, {"x_m": [-1000, -0.001, 0, 2.5], "y_m": [0, 0.3], "distance_m": [0.001, 1, 1000]}
    )
    expected = [values[name].values for name in ("x_m", "y_m", "distance_m")]
    np.testing.assert_array_equal(scenes.translation, np.stack(expected, axis=1))
    mixed = made({"x_m": 0.2, "bearing_y_deg": 10, "distance_m": 2})[1].translation[0]
    np.testing.assert_array_equal(mixed, [0.2, 2 * np.tan(np.radians(10)), 2])
