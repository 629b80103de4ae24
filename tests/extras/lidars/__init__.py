"""Tests of LiDAR packets, network captures and draco."""
