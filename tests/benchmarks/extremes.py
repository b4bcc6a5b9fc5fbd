"""What every refinement and every solver does at the extremes: tables over pipelines/extremes.

    python tests/benchmarks/extremes.py [FILE ...]

In this process, on one core, warnings raised as errors. What breaks a promise (see
:func:`broken_promises`) is told below the tables, and the exit status is 1.
"""

import argparse
import contextlib
import faulthandler
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sweep.evaluation.block import run_cells
from sweep.evaluation.results import Failure
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

FILES = sorted((Path(__file__).parents[2] / "pipelines" / "extremes").glob("*.toml"))
REFINEMENTS = ("none", "subpix", "contour", "apriltag")
SOLVERS = ("ippe_square", "ippe", "iterative", "sqpnp", "p3p", "ap3p")
REFINEMENT = "subpix"
"""The refinement on whose corners the table compares solvers."""


@dataclass
class Measured:
    """What N scenes of a pipeline gave under D detector settings and E estimators.

    ``values``: variable -> (N, ...), (D, N, ...) or (D, E, N, ...), by its stage.
    """

    pipeline: Pipeline
    values: dict[str, np.ndarray]
    failures: list[Failure] = field(default_factory=list)
    printed: list[str] = field(default_factory=list)

    @property
    def scenes(self):
        return len(self.values["true_rvec"])

    def treatments(self):
        """Yield for each value of the other treatment axes what it is, and who is who.

        (detector's text, estimator's text, {refinement: d}, {solver: e})
        """
        def grouped(stage, name, made):
            others = [axis.name for axis in self.pipeline.axes_of(stage) if axis.name != name]
            groups = {}
            for number, setting in enumerate(made):
                told = ", ".join(f"{other} = {_shown(getattr(setting, other))}" for other in others)
                groups.setdefault(told, {})[getattr(setting, name)] = number
            return groups.items()

        for searched, by_refinement in grouped(
            Stage.detection, "cornerRefinementMethod", self.pipeline.experiment.detectors
        ):
            for solved, by_solver in grouped(
                Stage.estimation, "solver", self.pipeline.experiment.estimators
            ):
                yield searched, solved, by_refinement, by_solver


def _shown(value):
    return str(value).lower() if isinstance(value, bool) else str(value)


def measured(pipeline, count=None):
    """Run a pipeline's scenes: all, or ``count`` of them, drawn by its seed."""
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    indices = Block((0,) * len(shape), shape).indices()
    if count is not None and count < len(indices[0]):
        chosen = np.random.default_rng(pipeline.seed).permutation(len(indices[0]))[:count]
        indices = [index[np.sort(chosen)] for index in indices]
    with all_that_is_printed() as printed, warnings.catch_warnings():
        warnings.simplefilter("error")
        cells = run_cells(pipeline.experiment, indices)
        columns = {v.name: cells.columns[v.name].astype(v.dtype) for v in SCHEMA}
    settings = pipeline.size(Stage.detection)
    leading = {
        Stage.scene: (),
        Stage.detection: (settings,),
        Stage.estimation: (settings, pipeline.size(Stage.estimation)),
    }
    values = {
        v.name: columns[v.name].reshape(*leading[v.stage], *columns[v.name].shape[1:])
        for v in SCHEMA
    }
    return Measured(pipeline, values, cells.failures, printed)


@contextlib.contextmanager
def all_that_is_printed():
    """Gather what this process writes to its output and error, the libraries' own code as well."""
    lines = []
    sys.stdout.flush()
    sys.stderr.flush()
    with tempfile.TemporaryFile("w+", buffering=1, errors="replace") as file:
        saved = {number: os.dup(number) for number in (1, 2)}
        for number in saved:
            os.dup2(file.fileno(), number)
        try:
            with contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
                yield lines
        finally:
            for number, kept in saved.items():
                os.dup2(kept, number)
                os.close(kept)
            file.seek(0)
            lines += file.read().splitlines()


ERRORS = ("translation_error_m", "rotation_error_rad", "rotation_error_deg", "normal_error_deg",
          "reprojection_error_px")
ALTERNATIVES = ("alternative_rotation_error_deg", "alternative_reprojection_error_px")


def broken_promises(result):
    """Return a line for each promise that does not hold: [] at every extreme."""
    values = result.values
    broken = [f"{f.stage} of scene {f.scene} raised: {f.text.strip().splitlines()[-1]}"
              for f in result.failures]
    broken += [f"printed: {line}" for line in result.printed]

    def promise(text, holds):
        count = np.size(holds) - np.count_nonzero(holds)
        if count:
            broken.append(f"{text}: not for {count} of {np.size(holds)}")

    def finite(name):
        kept = values[name]
        inner = tuple(range(-len(next(v.inner for v in SCHEMA if v.name == name)), 0))
        return np.isfinite(kept).all(axis=inner), np.isnan(kept).all(axis=inner)

    detection, estimate = values["detection"], values["estimate"]
    detected = detection == DetectionStatus.detected
    solved = estimate == EstimateStatus.solved
    promise("the truth is finite", np.isfinite(values["true_rvec"]).all(axis=1)
            & np.isfinite(values["true_tvec_m"]).all(axis=1))
    promise("a search ends in one of six ways",
            (detection >= DetectionStatus.detected) & (detection <= DetectionStatus.not_modelled))
    for flag in (DetectionStatus.not_visible, DetectionStatus.not_modelled):
        promise(f"{flag.name} is of the scene, whatever searches it",
                (detection == flag).all(axis=0) == (detection == flag).any(axis=0))
    there, absent = finite("corner_error_px")
    promise("corners are finite where detected, and absent elsewhere",
            np.where(detected, there, absent))

    promise(
        "what is detected is solved, or failed to be",
        np.isin(estimate, [EstimateStatus.solved, EstimateStatus.solver_failed])
        == detected[:, None],
    )
    promise("what is not detected is not estimated",
            (estimate == EstimateStatus.no_detection) == ~detected[:, None])
    for name in ERRORS:
        there, absent = finite(name)
        promise(f"{name} is finite where solved, and absent elsewhere",
                np.where(solved, there, absent))
    there = [np.isfinite(values[name]) for name in ALTERNATIVES]
    promise("the other solution has both its numbers, or none, and is of what is solved",
            (there[0] == there[1]) & (solved | ~there[0]))
    for name in ALTERNATIVES:
        promise(f"{name} is never infinite", ~np.isinf(values[name]))
    flipped = values["flipped"]
    promise("what is solved is flipped or not, and nothing else is",
            np.where(solved, np.isin(flipped, [Flipped.flipped, Flipped.not_flipped]),
                     flipped == Flipped.no_estimate))
    # Errors are float32: the estimate's own depth is known to their rounding.
    true_depth = values["true_tvec_m"][:, 2]
    depth = true_depth + values["translation_error_m"][..., 2].astype(np.float64)
    promise("what is solved lies before the camera", ~solved | (depth > -1e-6 * true_depth))
    return broken


def percent(share):
    """Return a share in words: neither all nor nothing is said where it is not so."""
    if share in (0, 1):
        return f"{share:.0%}"
    return f"{min(max(share, 0.01), 0.99):.0%}"


def detection_cell(flags):
    """Return the share of detected ones, and what became of most others."""
    counts = Counter(DetectionStatus(flag).name for flag in flags.tolist())
    cell = percent(counts.pop("detected", 0) / len(flags))
    if counts:
        name, count = counts.most_common(1)[0]
        cell += f", {name} {percent(count / len(flags))}"
    return cell


def solver_cell(detected, estimate, error_deg, flipped):
    """Return the median and worst error, and the shares that failed or are flipped if any."""
    if not detected.any():
        return "-"
    solved = estimate == EstimateStatus.solved
    cell = "-"
    if solved.any():
        cell = f"{figures(np.median(error_deg[solved]))} / {figures(error_deg[solved].max())}"
    shares = {"failed": (detected & ~solved).sum(), "flipped": (flipped == Flipped.flipped).sum()}
    for word, count in shares.items():
        if count:
            cell += f", {word} {percent(count / detected.sum())}"
    return cell


def figures(number):
    """Return an error in degrees to two figures, and at most three decimals."""
    return "<0.001" if number < 1e-3 else f"{number:.0f}" if number >= 10 else f"{number:.2g}"


def markdown(header, rows):
    """Return lines of a Markdown table whose columns are aligned."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return ["| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
            + " |" for line in lines]


def tables(results):
    """Return the two tables over all regimes: (name, Measured) each."""
    searches, solutions = [], []
    for name, result in results:
        values = result.values
        seen = None
        for searched, solved, by_refinement, by_solver in result.treatments():
            regime = ", ".join(filter(None, (name, searched, solved)))
            if searched != seen:  # once, however many estimators follow
                searches.append([", ".join(filter(None, (name, searched))), str(result.scenes)] + [
                    detection_cell(values["detection"][by_refinement[refinement]])
                    for refinement in REFINEMENTS
                ])
                seen = searched
            d = by_refinement[REFINEMENT]
            detected = values["detection"][d] == DetectionStatus.detected
            solutions.append([regime, str(detected.sum())] + [
                solver_cell(detected, *(values[variable][d, by_solver[solver]] for variable in
                                        ("estimate", "rotation_error_deg", "flipped")))
                for solver in SOLVERS
            ])
    return (
        markdown(["regime", "scenes", *REFINEMENTS], searches),
        markdown(["regime", "detected", *SOLVERS], solutions),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, default=FILES, metavar="FILE")
    # A crash must be told, though the error output is caught by then.
    faulthandler.enable(os.dup(sys.stderr.fileno()))
    results, broken = [], []
    for path in parser.parse_args().files:
        print(path.stem, end="", file=sys.stderr, flush=True)
        start = time.perf_counter()
        result = measured(Pipeline.from_toml(path))
        results.append((path.stem, result))
        broken += [f"{path.stem}: {line}" for line in broken_promises(result)]
        print(f": {time.perf_counter() - start:.1f} s", file=sys.stderr)
    found, estimated = tables(results)
    print("Share detected, and what became of most of the others:\n")
    print("\n".join(found))
    print(f"\nMedian / worst rotation error in degrees of what is solved from {REFINEMENT}\n"
          "corners, and the shares of the detected where the solver failed or chose the mirror:\n")
    print("\n".join(estimated))
    counts = np.sum([
        (result.scenes, result.values["detection"].size,
         np.count_nonzero(result.values["estimate"] == EstimateStatus.solved))
        for _, result in results
    ], axis=0)
    print("\n{:,} scenes, {:,} searches, {:,} poses solved: ".format(*counts)
          + (f"{len(broken)} promises broken:" if broken else "all finite, nothing raised, nothing "
             "printed."))
    print("\n".join(broken))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
