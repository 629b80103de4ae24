"""Decoders of compressed clouds and video. Imports `messages` and layers below it."""
