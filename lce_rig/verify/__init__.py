"""Pictures to judge a calibration by: the scan drawn into the camera's picture, and what each stage saw."""
