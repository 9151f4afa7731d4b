"""The live terminal screen of a collection."""
