"""Benchmarks behind docs/benchmarks.md, one module per table."""
