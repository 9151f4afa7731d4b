"""Images from a command's standard output."""
