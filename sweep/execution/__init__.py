"""Runs: blocks in processes or on a Dask cluster, reuse, progress, status and forecasts."""

#: Block timeout in seconds, more if blocks are long (`sweep.execution.forecast.MAX_BLOCK_SHARE`);
#: the search for a scene that never returns keeps within it.
TIME_LIMIT_S = 600.0
