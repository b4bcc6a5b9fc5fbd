"""Runs on a Dask cluster: blocks, calibration, reuse, progress, status and forecasts."""

BLOCK_TASK = "sweep.execution.block_task"
"""What a child process imports that measures scenes and computes blocks."""
