"""Checks that try to refute a result, and the verdict."""
