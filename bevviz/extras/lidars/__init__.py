"""Packets of Ouster, Hesai and Velodyne LiDARs, network captures of them, and clouds compressed by draco."""
