"""Jobs in child processes, a few at a time on this machine or on a Dask cluster."""
