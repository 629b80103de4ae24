"""Tests of `bevviz batch` and `bevviz causes`."""
