"""Many sessions of many robots: run them, keep their results, ask questions of the table."""
