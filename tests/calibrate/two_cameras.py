"""Two cameras side by side before the same boards and one LiDAR: sessions for tests/rigs/two_cameras.yaml."""

from dataclasses import replace

import numpy as np

from lce_rig.core.geometry import exp_so3, invert, perturb, pose
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, photograph, random_pose, scan_board

LEFT, RIGHT = "left", "right"
T_RIGHT_LEFT = pose(exp_so3(np.array([0.02, -0.03, 0.01])), np.array([-0.3, 0.005, 0.01]))
TRUTH = {LEFT: T_FORWARD, RIGHT: T_RIGHT_LEFT @ T_FORWARD}
"""T_cam_lidar (4, 4) by camera."""

REAL = Scenario(laser_bias_sigma_m=0.008, footprint_m=0.008, end_sigma_m=0.001)
Session = dict[str, list[Observation]]


def simulate_two(n, seed, scenario=REAL, *, right_corner_sigma_px=None, nudge=None, nudged_from=0):
    """Simulate n captures in which both cameras and the LiDAR see the board."""
    captures = _captures(seed, scenario, right_corner_sigma_px, nudge, nudged_from)
    pairs = [next(captures) for _ in range(n)]
    return {LEFT: [left for left, _ in pairs], RIGHT: [right for _, right in pairs]}


def _captures(seed, scenario, right_corner_sigma_px, nudge, nudged_from):
    rng = np.random.default_rng([seed, 2])
    bias_m = scenario.laser_bias_sigma_m * np.random.default_rng([seed, 1]).standard_normal(16)
    bias_m += scenario.range_offset_m - bias_m.mean()
    of_right = replace(scenario, corner_sigma_px=right_corner_sigma_px or scenario.corner_sigma_px)
    n_seen = 0
    while True:
        is_nudged = nudge is not None and n_seen >= nudged_from
        T_right_left = perturb(T_RIGHT_LEFT, nudge) if is_nudged and nudge is not None else T_RIGHT_LEFT
        T_left_board = random_pose(rng, scenario, BOARD)
        lidar = scan_board(invert(T_FORWARD) @ T_left_board, rng, scenario, BOARD, bias_m)
        left = photograph(T_left_board, rng, scenario, BOARD)
        right = photograph(T_right_left @ T_left_board, rng, of_right, BOARD)
        if lidar is not None and left is not None and right is not None:
            name = f"{n_seen:06d}"
            yield Observation(name, left, lidar), Observation(name, right, lidar)
            n_seen += 1


def only(captures, kept):
    """Keep captures by their place."""
    return [captures[k] for k in kept]
