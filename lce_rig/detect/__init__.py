"""Find the calibration board: in pictures and in LiDAR scans."""
