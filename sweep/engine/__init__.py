"""Blocks, the Dask run, the Zarr store. Nothing here knows of OpenCV."""
