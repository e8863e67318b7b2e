"""Pure tasks on this machine's threads or on a Dask cluster."""
