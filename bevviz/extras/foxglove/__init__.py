"""Server of the results of a live run for Foxglove."""
