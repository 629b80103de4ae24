"""Scans of Livox LiDARs, packets of Ouster, Hesai and Velodyne, network captures, and clouds by draco."""
