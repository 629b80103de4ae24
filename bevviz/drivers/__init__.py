"""Decoders of Livox scans, compressed clouds and video. Imports `messages` and layers below it."""
