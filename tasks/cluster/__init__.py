"""Stages made by other machines: a Dask cluster, its workers, and the orders that they are sent."""
