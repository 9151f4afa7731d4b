"""Boards that move during captures: their motion, and the channels' time offsets."""
