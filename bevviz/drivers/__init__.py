"""Decoders of LiDAR packets, compressed clouds and video. Imports `messages` and layers below it."""
