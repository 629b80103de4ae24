"""ROS: messages and the roles of their topics; and, in what imports rclpy, a running graph."""
