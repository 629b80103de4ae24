"""`bevviz sweep`: every value of one or two parameters on the same frames."""
