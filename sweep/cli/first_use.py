"""What is said before code is compiled for the first time."""

from __future__ import annotations

from sweep.compilation import is_compiled
from sweep.messages import notice
from sweep.plan.experiment import Pipeline

COMPILATION_S = 8
"""Seconds that the renderer takes to compile, which every run needs."""

PHOTOGRAPH_S = 20
"""Seconds that `photometric_real` takes beyond that."""

LIKELIHOOD_S = 10
"""Seconds that the bound and `photometric` take beyond that."""


def announce_compilation(pipeline: Pipeline) -> None:
    """Say in a line on stderr that a pipeline's functions are compiled, if they have not been."""
    fits = "photometric" in pipeline.values_of("solver")
    fits = fits or bool(set(pipeline.values_of("bound")) - {"none"})
    seconds = 0 if is_compiled("coverage.accumulate") else COMPILATION_S
    if fits and not is_compiled("likelihood.fit"):
        seconds += LIKELIHOOD_S
    real = "photometric_real" in pipeline.values_of("solver")
    if real and not is_compiled("photograph.locate_photograph"):
        seconds += PHOTOGRAPH_S
    if seconds:
        notice(f"compiling, once for this version: about {seconds} s")
