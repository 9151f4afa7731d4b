"""Velodyne packets from network recordings and live sensors."""
