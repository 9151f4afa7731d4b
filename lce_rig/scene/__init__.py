"""The scene as a witness: depth edges of scans on edges of images."""
