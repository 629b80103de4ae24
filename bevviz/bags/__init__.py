"""Recorded bags: MCAP, sqlite3 and ROS 1, sound or damaged, as messages and as frames."""
