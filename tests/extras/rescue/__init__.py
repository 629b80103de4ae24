"""Tests of reading damaged bags beyond the damage."""
