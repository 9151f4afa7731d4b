"""Sensors whose drivers publish ROS 2 topics."""
