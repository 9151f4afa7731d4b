"""The next placement of the board, and the predicted uncertainty of the extrinsics."""
