"""The requirements in a pipeline's section [require], their names checked."""

from __future__ import annotations

from collections.abc import Iterable

from sweep.analysis.requirements import read_requirements
from sweep.errors import PipelineError
from sweep.messages import MAX_LINE_LENGTH, plain, shown


def check_required(
    texts: Iterable[str], source: str, others: PipelineError | None = None,
    key: str = "require.all",
) -> None:
    """Check the requirements of a pipeline, by what can be required (`requirables`).

    Parameters
    ----------
    texts
        The requirements, which have the form of such.
    source
        The name that lines begin with.
    others
        The faults that the pipeline has besides.
    key
        Where the pipeline has them.

    Raises
    ------
    PipelineError
        One line for each fault.
    """
    known = () if others is None else others.faults
    faults = [*known, *(
        plain(line, MAX_LINE_LENGTH) for text, problem in read_requirements(texts)[1]
        if (line := f"{source}: {key} = {shown(text)}: {problem}") not in known)]
    if faults:
        raise PipelineError(faults)
