"""Attached sensors: each a source of samples with one reader thread, a bounded queue and counts of losses."""
