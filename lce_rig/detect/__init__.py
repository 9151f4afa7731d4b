"""Find the calibration board: in images and in LiDAR scans."""
