"""Checks whether a computer and its sensors are ready to collect: one function each, yielding findings."""
