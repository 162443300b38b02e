"""Processes for many runs: on this machine, or on a Dask cluster."""
