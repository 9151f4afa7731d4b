"""Check extrinsics on the scene: depth edges of scans against edges of images."""
