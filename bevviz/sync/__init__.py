"""Synchronisation of messages into frames. Imports `drivers` and below."""
