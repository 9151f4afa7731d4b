"""Many sessions of many robots: calibrate them, keep their results, query the table."""
