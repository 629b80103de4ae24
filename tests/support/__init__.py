"""Helpers that several test files, benchmarks and tools use."""
