"""ROS and Foxglove messages as arrays, and the roles of topics. Imports `model` and below, no rclpy."""
