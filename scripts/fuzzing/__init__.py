"""Hostile input for parsers: each target a module, each run reproducible from its seed."""
