"""Helpers without knowledge of perception: files, text, tables, pages, progress. Imports only `errors`."""
