"""Readers of recorded bags, sound or damaged. Imports `datasets` and the layers below it."""
