"""Rerun recordings: entities, loggers, layouts, sinks and readers. Imports `anomalies` and below."""
