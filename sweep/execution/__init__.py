"""Runs on a Dask cluster: blocks, calibration, reuse, progress, status and forecasts."""
