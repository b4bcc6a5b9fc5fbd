"""A standard scene, computed before any block: a machine that cannot do that computes nothing."""

from __future__ import annotations

import numpy as np

from sweep.errors import MachineFaultError
from sweep.evaluation.cells import run_cells
from sweep.evaluation.machine_faults import exception_line, local_fault
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes
from sweep.plan.parameters import Stage

SOLVERS = ("ippe_square", "photometric", "photometric_real")
"""Solvers whose compiled code is loaded, if the pipeline has them; else that of the first."""

TITLE = "A standard scene"

MAX_ERROR_RAD = 0.2
"""Rotation error of the standard scene; with the supported solvers it is below 0.05."""


def warm_up(pipeline: Pipeline) -> None:
    """Load the compiled code that a pipeline needs by computing a scene of known pose with it.

    Its renderers, bounds and solvers are used, without plug-ins, but none of its scenes, which may
    end the process.

    Raises
    ------
    MachineFaultError
        If the scene cannot be computed, or the marker's pose is not what it is known to be.
    """
    renderers = sorted(
        name for name in set(pipeline.values_of("renderer"))
        if pipeline.plugin("renderer", name) is None
    )
    solvers = [name for name in SOLVERS if name in pipeline.values_of("solver")]
    standard = Pipeline.from_dict({
        "title": TITLE,
        "camera": {"width_px": 160, "height_px": 120},
        "pose": {"side_px": 60, "tilt_deg": 45},
        "scene": {"noise_grey": 1.0},
        "axes": {
            "renderer": renderers or ["exact"],
            "bound": sorted(set(pipeline.values_of("bound"))),
            "solver": solvers or [SOLVERS[0]],
        },
    })
    lengths = [len(axis) for axis in scene_axes(standard)]
    indices = [index.ravel() for index in np.indices(lengths, dtype=np.intp)]
    try:
        cells = run_cells(standard, indices)
    except MachineFaultError:
        raise
    except Exception as error:
        raise local_fault(f"a standard scene raises {exception_line(error)}") from None
    for k in range(standard.size(Stage.detection, Stage.estimation)):
        error_rad = np.linalg.norm(cells.columns["rotation_error_rad"][k], axis=1)
        if not (error_rad < MAX_ERROR_RAD).all():  # NaN without a pose
            raise local_fault("the pose of a standard scene is computed wrongly")
