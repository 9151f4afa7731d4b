"""See `rclpy`."""
