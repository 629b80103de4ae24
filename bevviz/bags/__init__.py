"""Readers of recorded bags, sound or damaged. Imports `datasets` and below."""
