"""Tests of the extra ``pillars``."""
