"""Whether the workers of a cluster that is running can compute a pipeline as this process would."""

from __future__ import annotations

import asyncio
import os
import socket
from typing import Any

from distributed import Client

from sweep.errors import ArgumentError
from sweep.execution.limits import ANSWER_S, VERSIONS_S
from sweep.plan.experiment import Pipeline
from sweep.plan.plugins import lacking_plugins
from sweep.store.provenance import changes, fingerprint


def check_workers(client: Client, pipeline: Pipeline, argument: str, value: str) -> None:
    """Check that workers have the versions that this process has, and processes of their own.

    Workers that are stalled are left out: a worker that was not checked compares its versions with
    the store's when it gets its first block.

    Parameters
    ----------
    client
        A client of a scheduler that has workers.
    pipeline
        The pipeline; the digests of the files that it refers to are compared too.
    argument, value
        The argument by which the cluster was given, for messages.

    Raises
    ------
    ArgumentError
        If a worker has other versions, cannot import this package, or is a thread of this process;
        if none answers, or the scheduler went away.
    """
    own_versions, own_process, _ = _worker_identity(pipeline)
    try:
        identities = client.sync(_worker_identities, client, pipeline)
    except TimeoutError:
        raise ArgumentError(
            argument, value, f"none of its workers answers within {VERSIONS_S:.0f} s"
        ) from None
    except OSError:
        raise ArgumentError(argument, value, "the scheduler went away") from None
    except Exception as error:
        raise ArgumentError(
            argument, value, f"its workers cannot run sweep: {error}; install it there"
        ) from None
    if any(process == own_process for _, process, _ in identities.values()):
        raise ArgumentError(
            argument, value,
            "its workers are threads of this process, which a scene may end; "
            "start it with processes=True",
        )
    lines = sorted(
        f"  {worker}: {key} {theirs}, here {own}"
        for worker, (versions, _, _) in identities.items()
        for key, theirs, own in changes({"builds": {}, **versions}, own_versions)
    )
    lines += sorted(
        f"  {worker}: {line}" for worker, (_, _, lacking) in identities.items() for line in lacking
    )
    if lines:
        raise ArgumentError(
            argument, value,
            "workers with other versions; install the same everywhere\n" + "\n".join(lines),
        )


def _worker_identity(pipeline: Pipeline) -> tuple[dict[str, Any], tuple[str, int], list[str]]:
    """Return the versions that numbers depend on here, the process, and plug-ins that lack."""
    lacking = lacking_plugins(pipeline.plugins, pipeline.folder)
    return fingerprint(pipeline), (socket.gethostname(), os.getpid()), lacking


async def _worker_identities(
    client: Client, pipeline: Pipeline
) -> dict[str, tuple[dict[str, Any], tuple[str, int], list[str]]]:
    """Return :func:`_worker_identity` of each worker by address; not of those that are stalled."""
    questions = [
        asyncio.ensure_future(client.run(_worker_identity, pipeline, workers=[worker]))
        for worker in await client.nthreads()
    ]
    if not questions:
        raise TimeoutError
    done, _ = await asyncio.wait(
        questions, timeout=VERSIONS_S, return_when=asyncio.FIRST_COMPLETED
    )
    if not done:
        for question in questions:
            question.cancel()
        raise TimeoutError
    done, late = await asyncio.wait(questions, timeout=ANSWER_S)
    for question in late:
        question.cancel()
    identities = {}
    for question in done:
        try:
            identities.update(question.result())
        except OSError:
            if client.status != "running":
                raise
            # The worker left meanwhile, as those of a cluster that adapts to its work do.
    return identities
