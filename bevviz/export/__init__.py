"""``bevviz export``: a drive in the form of a data set, with what was found as labels to begin with."""
