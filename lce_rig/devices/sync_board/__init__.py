"""The sync board on a serial port."""
