"""Results on robots: all files of a set at once, earlier sets kept, over a folder or OpenSSH."""
