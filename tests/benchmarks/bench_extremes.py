"""What every solver does at the extremes: a table over pipelines/extremes.

    python -m tests.benchmarks extremes

In this process, on one core, warnings raised as errors. What breaks a promise (see
:func:`broken_promises`) is told below the table, and the exit status is 1.
"""

import itertools
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from benchmarks.tables import header, row
from support.blocks import whole
from support.flags_and_numbers import faults
from sweep.evaluation.block import run_cells
from sweep.evaluation.results import Failure
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

FILES = sorted((Path(__file__).parents[2] / "pipelines" / "extremes").glob("*.toml"))
SOLVERS = ("ippe_square", "ippe", "iterative", "sqpnp", "p3p", "ap3p")
STAGES = (Stage.scene, Stage.detection, Stage.estimation)
REFINEMENT = "subpix"
"""The refinement on whose corners the table compares solvers."""

QUICK = {"FILES": [path for path in FILES if path.stem == "tilt_zero"]}


@dataclass
class Measured:
    """What N scenes of a pipeline gave under D detector settings and E estimators.

    ``values``: variable -> (N, ...), (D, N, ...) or (D, E, N, ...), by its stage.
    """

    pipeline: Pipeline
    values: dict[str, np.ndarray]
    failures: list[Failure]


def measured(pipeline, count=None):
    """Run a pipeline's scenes: all, or ``count`` of them, drawn by its seed."""
    indices = whole(pipeline).indices()
    if count is not None and count < len(indices[0]):
        chosen = np.random.default_rng(pipeline.seed).permutation(len(indices[0]))[:count]
        indices = [index[np.sort(chosen)] for index in indices]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cells = run_cells(pipeline.experiment, indices)
        columns = {v.name: cells.columns[v.name].astype(v.dtype) for v in SCHEMA}
    settings = (pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
    values = {
        v.name: columns[v.name].reshape(
            *settings[: STAGES.index(v.stage)], *columns[v.name].shape[1:])
        for v in SCHEMA
    }
    return Measured(pipeline, values, cells.failures)


def broken_promises(result):
    """Return a line for each promise that does not hold: [] at every extreme."""
    values = result.values
    broken = [f"{f.stage} of scene {f.scene} raised: {f.text.strip().splitlines()[-1]}"
              for f in result.failures]
    leading = ("detector", "estimator")
    broken += [f"{name}: {fault}" for name, fault in faults(result.pipeline, SCHEMA, {
        v.name: xr.DataArray(
            values[v.name], dims=(*leading[: STAGES.index(v.stage)], "scene", *v.inner))
        for v in SCHEMA})]
    detection, estimate = values["detection"], values["estimate"]
    other = np.array([values[f"alternative_{name}"] for name in (
        "rotation_error_deg", "reprojection_error_px")])
    # Errors are float32: the estimate's own depth is known to their rounding.
    true_depth = values["true_tvec_m"][:, 2]
    depth = true_depth + values["translation_error_m"][..., 2].astype(np.float64)
    promises = {
        "a search ends in one of six ways":
            (detection >= DetectionStatus.detected) & (detection <= DetectionStatus.not_modelled),
        "what is detected is solved, or failed to be":
            np.isin(estimate, [EstimateStatus.solved, EstimateStatus.solver_failed])
            == (detection == DetectionStatus.detected)[:, None],
        "the other solution has both its numbers, or none, and no infinite one":
            (np.isfinite(other[0]) == np.isfinite(other[1])) & ~np.isinf(other).any(axis=0),
        "what is solved lies before the camera":
            (estimate != EstimateStatus.solved) | (depth > -1e-6 * true_depth),
    } | {
        f"{flag.name} is of the scene, whatever searches it":
            (detection == flag).all(axis=0) == (detection == flag).any(axis=0)
        for flag in (DetectionStatus.not_visible, DetectionStatus.not_modelled)
    }
    return broken + [f"{text}: not for {np.size(holds) - np.count_nonzero(holds)} of "
                     f"{np.size(holds)}" for text, holds in promises.items() if not np.all(holds)]


def solver_cell(detected, estimate, error_deg, flipped):
    """Return the median and worst error, and the shares that failed or are flipped if any."""
    if not detected.any():
        return "-"
    solved = estimate == EstimateStatus.solved
    cell = "-"
    if solved.any():
        cell = f"{np.median(error_deg[solved]):.2g} / {error_deg[solved].max():.2g}"
    shares = {"failed": (detected & ~solved).sum(), "flipped": (flipped == Flipped.flipped).sum()}
    for word, count in shares.items():
        if count:
            cell += f", {word} {count / detected.sum():.0%}"
    return cell


def print_rows(name, result):
    """Print the rows of a regime: one for each value of its other treatment axes."""
    pipeline, values = result.pipeline, result.values
    made, rows = pipeline.experiment, {}
    for (d, detector), (e, estimator) in itertools.product(
            enumerate(made.detectors), enumerate(made.estimators)):
        if detector.cornerRefinementMethod != REFINEMENT:
            continue
        detected = values["detection"][d] == DetectionStatus.detected
        words = [f"{axis.name} = {getattr(setting, axis.name)}"
                 for stage, setting in ((Stage.detection, detector), (Stage.estimation, estimator))
                 for axis in pipeline.axes_of(stage)
                 if axis.name not in ("cornerRefinementMethod", "solver")]
        cells = rows.setdefault(", ".join([name, *words]), {"detected": detected.sum()})
        cells[estimator.solver] = solver_cell(detected, *(
            values[variable][d, e] for variable in ("estimate", "rotation_error_deg", "flipped")))
    for label, cells in rows.items():
        row(label, *(cells[column] for column in ("detected", *SOLVERS)))


def main():
    broken, counts = [], np.zeros(3, dtype=int)
    print(f"Median / worst rotation error in degrees of what is solved from {REFINEMENT} corners,\n"
          "and the shares of the detected where the solver failed or chose the mirror:\n")
    header("regime", "detected", *SOLVERS)
    for path in FILES:
        result = measured(Pipeline.from_toml(path))
        print_rows(path.stem, result)
        broken += [f"{path.stem}: {line}" for line in broken_promises(result)]
        counts += (len(result.values["true_rvec"]), result.values["detection"].size,
                   np.count_nonzero(result.values["estimate"] == EstimateStatus.solved))
    print("\n{:,} scenes, {:,} searches, {:,} poses solved: ".format(*counts)
          + (f"{len(broken)} promises broken:" if broken else "all finite, nothing raised."))
    print("\n".join(broken))
    return int(bool(broken))
