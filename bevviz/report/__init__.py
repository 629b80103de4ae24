"""Bug reports: a short bag, its results, and a check that repeats them. Imports `pipeline` and below."""
