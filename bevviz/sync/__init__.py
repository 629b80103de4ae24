"""Synchronisation of messages into frames. Imports `drivers` and layers below it."""
