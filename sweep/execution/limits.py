"""The limits of a run: blocks in flight, seconds, retries, sizes; each with its reason.

Limits of other packages stay with what they limit: the shares of a block's time that the search
for a crashing scene may use in :mod:`sweep.isolation.crash_isolation`, the failures that a store
keeps in :mod:`sweep.store.outcome`. This module imports nothing.
"""

from __future__ import annotations

# Blocks on a cluster (`sweep.execution.on_cluster`)

BLOCKS_PER_THREAD = 3
"""Blocks in flight per worker thread: enough that none waits, few enough that none pile up."""

MAX_DEATHS = 10
"""How often a block is submitted again after its worker died."""

MAX_ATTEMPTS = 10
"""On how many workers a block is tried that fails by faults of their machines."""

MAX_WORKER_FAULTS = 3
"""Blocks that a worker fails and others compute, after which it is used no more."""

FAULT_WINDOW = 10
"""Blocks that each worker computes meanwhile: more seldom faults are not the worker's alone."""

MAX_FAILED_BLOCKS = 10
"""Failed blocks after which no more are submitted."""

# Small runs (`sweep.execution.engines`)

SMALL_RUN_S = 3.0
"""Work up to which a run needs no cluster, which takes about as long to start and to end."""

SMALL_RUN_LIMIT_S = 10.0
"""Seconds after which the rest of a run that was taken for a small one goes to a cluster."""

# Time limits

TIME_LIMIT_S = 600.0
"""Block timeout in seconds, more if blocks are long (:data:`MAX_BLOCK_SHARE`); the search for a
scene that never returns keeps within it."""

TIMING_S = 0.2
"""Seconds of the batch of scenes that is timed before blocks are cut."""

TIMING_SHARE = 1 / 8
"""Share of a block's time limit after which a batch is abandoned."""

TIMING_LIMIT_S = 5.0
"""Seconds after which it is abandoned in any case: it is known by then that blocks are small."""

PLAN_SCENES_S = 1.5
"""The same for a forecast, which is answered within 5 s."""

PLAN_EFFECTS_S = 1.5
"""Seconds of a forecast in which effects are measured, and a pilot of a run in waves is made."""

# The cluster (`sweep.execution.cluster`)

ANSWER_S = 10.0
"""How long a scheduler, and then its first worker, may take to answer."""

VERSIONS_S = 60.0
"""How long all workers may take to report their versions, for which they import this package."""

THREAD_COUNT_INTERVAL_S = 1.0
"""How often the scheduler is asked what workers it has."""

THREAD_COUNT_TIMEOUT_S = 2.0
"""How long a run waits for that answer."""

NO_WORKERS_TIMEOUT_S = 60.0
"""How long a run waits for a first worker, or after the last one left or was paused."""

STALL_S = 60.0
"""How long no block may be finished before a line says what the workers do."""

# The size of blocks (`sweep.execution.forecast`)

BLOCK_S = 2.0
"""Work in a block of most runs: a lost block costs its work."""

MIN_BLOCK_S = 0.1

WAVE_BLOCK_S = 0.5
"""Least work in a block of a run in waves, if all its scenes are needed: soon few of them are."""

BLOCKS_PER_S = 75
"""Blocks that all workers together finish in a second: a scheduler does about 180 of them, so that
larger clusters get larger blocks."""

MAX_BLOCKS = 100_000
"""Blocks of a run, of about 25 files each: longer runs get larger blocks."""

MAX_BLOCK_S = 3600.0
"""Work that a block takes at most: jobs of clusters end after hours, and lose a block each. A
run of 11 years of one processor has 100,000 of these; longer ones have more."""

MAX_BLOCK_SHARE = 1 / 10
"""Share of a block's time limit that its work is to take: scenes may cost more than was measured.
A time limit that the user gives bounds the work; else the work raises the limit."""

BLOCKS_PER_WORKER = 6
"""With little work, blocks are cut smaller so that every worker has some until the end."""

MAX_BLOCK_BYTES = 256_000_000
MAX_BLOCK_SCENES = 200_000
