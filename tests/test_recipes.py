"""The recipes of the developers' guide, followed on one changed copy of the package."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sweep
from sweep.evaluation import variables
from sweep.evaluation.variables import check_complete
from sweep.experiment.parameters import Stage
from sweep.measure.flags import EstimateStatus

PACKAGE = Path(sweep.__file__).parent
TESTS = Path(__file__).parent


def added(folder, *changes):
    """Copy the package to a folder; each change (file, anchor, text) puts text after an anchor.

    An anchor stands once in its file; without one, the file is new, and without a text the anchor
    goes.
    """
    shutil.copytree(PACKAGE, folder / "sweep")  # with its compiled code, for unchanged sources
    for file, anchor, text in changes:
        path = folder / "sweep" / file
        if anchor is None:
            path.write_text(text, encoding="utf-8")
            continue
        source = path.read_text(encoding="utf-8")
        assert source.count(anchor) == 1, f"{file}: {anchor!r} stands {source.count(anchor)} times"
        path.write_text(
            source.replace(anchor, "" if text is None else anchor + text), encoding="utf-8")
    return folder


EFFECTS = """
    Effect(
        "haze", "light",
        {"haze": parameter(0.0, "share of the light that haze adds", low=0, high=1, drawable=True)},
        apply=lambda light, patch: light * (1 - patch.values["haze"]) + 200 * patch.values["haze"],
    ),
    Effect(
        "column noise", "signal",
        {
            "column_noise_grey": parameter(0.0, "noise of columns", low=0, high=100),
            "column_period_px": parameter(2.0, "their period", low=1, high=100),
        },
        needs={"column_period_px": ("column_noise_grey",)}, random=True, widens="noise",
        apply=lambda signal, patch: signal + patch.values["column_noise_grey"] * (
            (patch.left + np.arange(signal.shape[1])) % patch.values["column_period_px"] == 0
        ) * patch.normals("column_noise_grey", signal.shape),
    ),
"""

SOLVER = """
import numpy as np
from sweep.measure.estimation import Estimates
from sweep.measure.flags import EstimateStatus

def frontal(detections):
    estimates = Estimates.none(len(detections.corners), EstimateStatus.solved)
    sides = np.roll(detections.corners, -1, axis=1) - detections.corners
    view = detections.cameras.view
    depth = view[:, 0] * detections.size_m / np.linalg.norm(sides, axis=2).mean(axis=1)
    centre = (detections.corners.mean(axis=1) - view[:, 2:]) / view[:, :2]
    estimates.rotation[:] = np.diag([1.0, -1.0, -1.0])
    estimates.translation[:] = np.column_stack([centre * depth[:, None], depth])
    estimates.reprojection_px[:] = [image.mean() for image in detections.images]
    return estimates
"""
"""A frontal pose at the depth of the corners' mean side; it reports the image's mean, too."""

SOLVER_RECORD = """
    "frontal": Solver(meaning="a frontal pose", make=lambda _: frontal, needs_images=True),
"""

FLAG, SENTENCE = len(EstimateStatus), "The pose is unlikely beforehand; it is stored."

VARIABLE = """    Variable("range_error", _E, "f4", "estimated over true distance, minus 1",
             present_when=_POSE),
"""
FUNCTION = """    "range_error": lambda results: (
        np.linalg.norm(results.estimates.translation, axis=1)
        / np.linalg.norm(results.estimates.translation - results.error.translation_m, axis=1) - 1
    ),
"""

#: OpenCV's fields are all declared: one goes, and comes back by the recipe.
DECLARED = """    minOtsuStdDev: float = parameter(
        5.0, "smallest standard deviation at which Otsu's threshold is taken", 0,
        unit="grey level",
    )
"""
SETTING = """    minOtsuStdDev: float = parameter(5.0, "least deviation", 0, unit="grey level")
"""

SCRIPT = """
import json
import numpy as np
import sweep
from support.flags_and_numbers import contradiction
from support.here import calls_here
from sweep.cli import main
from sweep.evaluation.block import run_cells
from sweep.evaluation.results import to_dataset_layout
from sweep.evaluation.search import detections_of, scenes_at, search_windows
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, VARIABLES
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.model.renderers import marker_levels
from sweep.cli.reference import TABLES

def effects():
    pipeline = Pipeline.from_dict({
        "camera": {"width_px": 160, "height_px": 120}, "marker": {"size_m": 0.05},
        "pose": {"distance_m": 0.3, "tilt_deg": 20},
        "scene": {"background": 90, "black": 20, "white": 230, "bound": "known_blur",
                  "column_period_px": 3},
        "axes": {"haze": [0, 0.25], "column_noise_grey": [0, 6], "window": ["auto", "full"]},
    })
    indices = [index.ravel() for index in np.indices((2, 2, 2))]
    batch = scenes_at(pipeline.experiment, indices)
    (result,) = detections_of(batch, np.ones((8, 1), dtype=bool), [], keep=True)
    box, setting = tuple(batch.boxes[0].tolist()), pipeline.experiment.detectors[0]
    mean, share = marker_levels(batch.scenes, 0, box)
    windows = search_windows(batch.scenes, batch.boxes, setting, np.zeros(8, dtype=bool))
    bound = run_cells(pipeline.experiment, indices).columns["bound"][0]
    return {
        "box": box, "levels": (mean + (1 - share) * 90).tolist(),
        "images": [result.images[row].tolist() for row in range(8)],
        "origins": result.origins.tolist(), "windows": windows.tolist(),
        "bound": [BoundStatus(int(flag)).name for flag in bound],
        "table": TABLES["effects"]().rows,
    }

def solver():
    pipeline = Pipeline.from_dict({
        "marker": {"size_m": 0.05}, "pose": {"distance_m": 0.5, "bearing_x_deg": 4},
        "axes": {"solver": ["frontal", "ippe_square"], "roll_deg": [0, 90]},
    })
    columns = run_cells(pipeline.experiment, [np.arange(2)]).columns
    return {
        "estimate": [column.tolist() for column in columns["estimate"]],
        "position": columns["translation_error_m"][0].tolist(),
        "rotation": [column.tolist() for column in columns["rotation_error_deg"]],
        "grey": columns["reprojection_error_px"][0].tolist(),
        "table": TABLES["solvers"]().rows,
    }

def setting():
    pipeline = Pipeline.from_dict({
        "marker": {"size_m": 0.05}, "pose": {"distance_m": 0.5},
        "axes": {"minOtsuStdDev": [5, 200]},
    })
    flags = run_cells(pipeline.experiment, []).columns["detection"]
    return {
        "detection": [DetectionStatus(int(flag)).name for flag in flags[:, 0]],
        "table": TABLES["detector"]().rows,
    }

def flag():
    pipeline = Pipeline.from_dict(
        {"marker": {"size_m": 0.05}, "axes": {"distance_m": [0.3, 0.5, 1e3]}})
    block = Block((0,), (3,))
    columns = run_cells(pipeline.experiment, block.indices()).columns
    values = {v.name: to_dataset_layout(v, pipeline, block, columns[v.name]) for v in SCHEMA}
    unlikely, flipped = values["estimate"].copy(), values["flipped"].copy()
    unlikely[0], flipped[0] = EstimateStatus.unlikely, Flipped.no_estimate
    lost = values["rotation_error_deg"].copy()
    lost[0] = np.nan
    new = {"estimate": unlikely, "flipped": flipped}
    return {
        "attributes": VARIABLES["estimate"].attributes(),
        "contradictions": [contradiction(pipeline, SCHEMA, values | changed) for changed in (
            {}, new, new | {"rotation_error_deg": lost}, {"estimate": unlikely},
            {"estimate": np.full_like(unlikely, len(EstimateStatus))},
        )],
        "tables": [TABLES["flags"]().rows, TABLES["variables"]().rows],
    }

def variable():
    with calls_here():
        results = sweep.run({
            "marker": {"size_m": 0.05}, "scene": {"background": 255}, "pose": {"jitter_px": 0.5},
            "axes": {"distance_m": [0.4, 40], "trial": 3, "solver": ["ippe", "iterative"]},
        }, store="new.zarr")
        verified = main(["verify", "new.zarr"])
    error, truth = results["range_error"], results["true_tvec_m"]
    found, true = ((tvec**2).sum("xyz") ** 0.5
                   for tvec in (truth + results["translation_error_m"], truth))
    expected = (found / true - 1).transpose(*error.dims)
    return {
        "same": [error.dims == results["nees"].dims, error.dtype == "f4", verified == 0],
        "solved": (results["estimate"].values == 1).ravel().tolist(),
        "error": [None if np.isnan(each) else float(each) for each in error.values.ravel()],
        "expected": expected.values.ravel().tolist(), "description": error.attrs["description"],
        "table": [row[:2] for row in TABLES["variables"]().rows],
    }

print(json.dumps({each.__name__: each() for each in (effects, solver, setting, flag, variable)}))
"""

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """What the script prints with all that is added."""
    (highest,) = (flag for flag in EstimateStatus if flag == FLAG - 1)
    folder = added(
        tmp_path_factory.mktemp("recipes"),
        ("model/effects.py", "import dataclasses\n", "import numpy as np\n"),
        ("model/effects.py", "EFFECTS: tuple[Effect, ...] = (", EFFECTS),
        ("measure/frontal.py", None, SOLVER),
        ("measure/estimators.py", ", PoseEstimator, credible_estimates\n",
         "from sweep.measure.frontal import frontal\n"),
        ("measure/estimators.py", "SOLVERS: dict[str, Solver] = {", SOLVER_RECORD),
        ("measure/detectors.py", DECLARED, None),
        ("measure/detectors.py", "OpenCV's own name and default.\"\"\"\n", SETTING),
        ("measure/flags.py", f'"{highest.meaning}")\n',
         f'    unlikely = flag({FLAG}, "{SENTENCE}", present=True)\n'),
        ("experiment/schema.py", "             flags=flags.Flipped),\n", VARIABLE),
        ("evaluation/variables.py", '    "flipped": _flipped,\n', FUNCTION),
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(TESTS)])}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, cwd=folder,
        capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_effects_are_a_record_each(results):
    got = results["effects"]
    x0, y0, x1, y1 = got["box"]
    frame = np.full((120, 160), 90.0)
    frame[y0:y1, x0:x1] = got["levels"]
    hazy = frame * (1 - 0.25) + 200 * 0.25
    for row, expected in ((0, frame), (1, frame), (4, hazy), (5, hazy)):
        image, (left, top) = np.array(got["images"][row]), got["origins"][row]
        height, width = image.shape
        whole = np.clip(np.floor(expected + 0.5 + 1e-9), 0, 255)
        np.testing.assert_array_equal(image, whole[top : top + height, left : left + width])
    # Neither is part of the bound's model; without them there is no noise.
    assert got["bound"] == ["no_noise"] * 2 + ["not_in_model"] * 6
    quiet, noisy = np.array(got["windows"][0]), np.array(got["windows"][2])
    assert (noisy[:2] <= quiet[:2]).all()
    assert (noisy[2:] >= quiet[2:]).all()
    assert (noisy != quiet).any()
    rows = [row[:6] for row in got["table"]]
    assert ["haze", "haze", "0", "light", "no", "no"] in rows
    assert ["column noise", "column_noise_grey", "0", "signal", "yes", "no"] in rows


def test_a_solver_is_one_class_and_one_record(results):
    got = results["solver"]
    assert got["estimate"] == [[1, 1], [1, 1]]
    np.testing.assert_allclose(got["position"], 0, atol=1e-2)
    np.testing.assert_allclose(got["rotation"][0], [0, 90], atol=1e-4)
    assert max(got["rotation"][1]) < 15
    assert all(0 < grey < 255 for grey in got["grey"])
    assert ["frontal", "a frontal pose", "pixels", "no"] in got["table"]


def test_a_detector_setting_is_one_field(results):
    got = results["setting"]
    assert got["detection"] == ["detected", "rejected"]
    (row,) = [row for row in got["table"] if "minOtsuStdDev" in row[0]]
    assert "least deviation" in str(row)


def test_a_flag_is_one_member(results):
    got = results["flag"]
    assert got["attributes"]["flag_values"] == list(range(FLAG + 1))
    assert got["attributes"]["flag_meanings"].split()[-1] == "unlikely"
    # Its pose must be stored, and the solution counts as no estimate for the flips.
    assert got["contradictions"] == [
        "", "", "rotation_error_deg: no number although estimate says that there is one",
        "flipped: contradicts estimate", f"estimate: unknown flag {FLAG + 1}",
    ]
    flags, rows = got["tables"]
    assert ["estimate", str(FLAG), "unlikely", SENTENCE, "yes"] in flags
    assert any("solved or not_explained or unlikely" in row[-1] for row in rows)


def test_a_variable_is_a_record_and_a_function(results):
    got = results["variable"]
    assert got["same"] == [True] * 3
    solved, error = np.array(got["solved"]), np.array(got["error"], dtype=float)
    assert (np.isfinite(error) == solved).all()
    assert 0 < solved.sum() < solved.size
    np.testing.assert_allclose(error[solved], np.array(got["expected"])[solved], atol=1e-6)
    assert got["description"].startswith("estimated over true")
    assert ["range_error", "estimation"] in got["table"]
    # One without the other is refused.
    tables = {Stage.scene: variables.SCENE, Stage.detection: variables.DETECTION}
    check_complete(tables)
    lacking = {name: f for name, f in variables.SCENE.items() if name != "bound"}
    with pytest.raises(TypeError, match="variable bound of stage scene: no function computes it"):
        check_complete({Stage.scene: lacking})
    with pytest.raises(TypeError, match="variable glare of stage detection: the schema lacks it"):
        check_complete({Stage.detection: variables.DETECTION | {"glare": None}})
