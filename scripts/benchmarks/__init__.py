"""What docs/benchmarks.md claims, measured: one module a table."""
