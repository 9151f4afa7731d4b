"""Algorithm 1 of LCE-Calib: extrinsics from planes and ring ends, with a certificate."""
