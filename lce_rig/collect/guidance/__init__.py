"""Where to hold the board next, and how well the extrinsics are going to be known."""
