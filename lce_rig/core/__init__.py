"""Types and mathematics for all other packages: numpy and scipy only, no files, no devices."""
