"""Boards that move while captures are taken: their motion, and the channels' time offsets."""
