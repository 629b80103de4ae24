"""Live runs beside a robot. Every module that imports rclpy is here. Imports `compare` and below."""
