"""Bug reports: a window of a bag, its results, and their check. Imports `pipeline` and below."""
