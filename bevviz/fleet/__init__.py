"""Runs over many bags, on this machine or on a cluster. Imports `report` and below."""
