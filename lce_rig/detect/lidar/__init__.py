"""The board in LiDAR scans: plates, their outline, ring ends, tracking."""
