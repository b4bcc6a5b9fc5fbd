"""Runs on a Dask cluster: what is computed where, in blocks, and how far it is."""
