"""Published methods to compare with, on the same detected boards and with the same kind of result."""
