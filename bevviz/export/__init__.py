"""Export of a drive as a data set. Imports `pipeline` and the layers below it."""
