"""Runs in which no block is finished for long: the reason is said, or ends the run."""

from __future__ import annotations

import time

from distributed import Client

from sweep.errors import RunError
from sweep.execution.distributed_internals import worker_deaths, worker_states
from sweep.execution.limits import (
    MAX_BLOCK_SHARE,
    MAX_WORKER_DEATHS,
    STALL_S,
    STATES_INTERVAL_S,
    THREAD_COUNT_TIMEOUT_S,
)
from sweep.isolation.machine_memory import deaths_reason, memory_kills
from sweep.messages import notice


class StallWatch:
    """Watches for a run in which nothing is finished.

    A line says why after :data:`~sweep.execution.limits.STALL_S`, and again after twice that time,
    four times, and so on. The run ends if it would never go on: if all workers are paused for so
    long, or die again and again.

    Parameters
    ----------
    client
        The cluster's client.
    time_limit_s
        Block timeout in seconds, for the line.
    """

    def __init__(self, client: Client, time_limit_s: float) -> None:
        self._client = client
        self._time_limit_s = time_limit_s
        self._kills = memory_kills()
        self.finished()

    def finished(self) -> None:
        """Note that a block was finished."""
        self._since = self._asked = time.monotonic()
        self._paused_since: float | None = None
        self._deaths_before: int | None = None
        self._dying = False
        self._next_line_s = STALL_S

    def check(self, blocks: int) -> None:
        """Say why nothing is finished, if that has lasted; called often while ``blocks`` are out.

        Raises
        ------
        RunError
            If for :data:`~sweep.execution.limits.STALL_S` all workers have been paused, or each
            died :data:`~sweep.execution.limits.MAX_WORKER_DEATHS` times on average.
        """
        now = time.monotonic()
        if now < self._asked + STATES_INTERVAL_S:
            return
        self._asked = now
        silent_s = now - self._since
        reason = self._reason(blocks, now)
        paused = self._paused_since is not None and now >= self._paused_since + STALL_S
        if paused or (self._dying and silent_s >= STALL_S):
            raise RunError(f"no block was finished for {silent_s:.0f} s: {reason}")
        if silent_s >= self._next_line_s and reason:
            self._next_line_s *= 2
            notice(f"no block was finished for {silent_s:.0f} s: {reason}")

    def _reason(self, blocks: int, now: float) -> str:
        """Return what is wrong, empty if nothing is; note what may end the run."""
        try:
            states = worker_states(self._client, THREAD_COUNT_TIMEOUT_S)
            deaths = worker_deaths(self._client, THREAD_COUNT_TIMEOUT_S)
        except (OSError, TimeoutError):
            return "the scheduler does not answer"
        if self._deaths_before is None:
            self._deaths_before = deaths
        deaths -= self._deaths_before
        self._dying = deaths >= MAX_WORKER_DEATHS * max(len(states), 1)
        if deaths:
            return f"workers died {deaths} times meanwhile; {deaths_reason(self._kills)}"
        if not states:
            return "there are no workers; start some"
        paused = sum(status == "paused" for status in states.values())
        if paused < len(states):
            self._paused_since = None
        elif self._paused_since is None:
            self._paused_since = now
        if paused:
            return (
                f"{paused} of {len(states)} workers are paused by Dask, because they use most of "
                "the memory that they may; give them more (`dask worker --memory-limit`), or set "
                "distributed.worker.memory.pause to false in Dask's configuration there"
            )
        if now < self._since + MAX_BLOCK_SHARE * self._time_limit_s:
            return ""  # a block may well take as long
        line = (
            f"{blocks} blocks are with {len(states)} workers, which compute; a block ends after "
            f"at most {self._time_limit_s:.0f} s (time limit)"
        )
        if now > self._since + self._time_limit_s:
            line += ": they hang, or do other work first; their logs may tell"
        return line
