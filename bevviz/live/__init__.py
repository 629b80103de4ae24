"""Live runs beside a robot, and everything that imports rclpy. Imports `compare` and below."""
