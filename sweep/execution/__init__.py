"""Runs: blocks in processes or on a Dask cluster, reuse, progress, status and forecasts."""

#: Module that a child process imports to time scenes and compute blocks.
BLOCK_TASK = "sweep.execution.block_task"

#: Block timeout in seconds, more if blocks are long (`sweep.execution.forecast.MAX_BLOCK_SHARE`);
#: the search for a scene that never returns keeps within it.
TIME_LIMIT_S = 600.0
