"""The errors of a LiDAR with infinitely thin beams that measures exactly."""

from lce_rig.simulate import LidarNoise

EXACT = LidarNoise(
    range_sigma_m=0.0,
    laser_sigma_m=0.0,
    dark_bias_m=0.0,
    weak_bias_m=0.0,
    divergence_rad=(0.0, 0.0),
    exit_size_m=(0.0, 0.0),
    edge_growth_m=0.0,
    dropout=0.0,
    is_quantised=False,
)
