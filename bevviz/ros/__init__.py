"""The parts of bevviz that meet a running ROS 2 graph; nothing else imports rclpy."""
