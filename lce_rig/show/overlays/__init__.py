"""Images for judging a calibration: point clouds projected into images, and detections of each stage."""
