"""Joint maximum-likelihood estimate of extrinsics, board poses and the sensors' constant errors."""
