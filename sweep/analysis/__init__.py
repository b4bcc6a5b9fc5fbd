"""Statistics of what was measured. Nothing here knows of files or of Dask."""
