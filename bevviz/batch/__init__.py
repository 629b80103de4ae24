"""Many bags: a job for each, run by processes of this machine or of a Dask cluster; one summary of all."""
