"""Types and mathematics everything else is built on: numpy and scipy only, no files, no devices."""
