"""Readers of damaged bags."""
