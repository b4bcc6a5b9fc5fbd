"""Dataset in, Dataset out. Nothing here knows of files or Dask clients."""
