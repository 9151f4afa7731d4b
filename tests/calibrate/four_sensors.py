"""Two cameras and two LiDARs on one rig; each placement of the board is seen by two or three of them."""

import numpy as np

from lce_rig.core.geometry import difference, exp_so3, invert, pose
from lce_rig.detect.detection import Detections
from lce_rig.rig import Rig
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, in_use, photograph, random_pose, scan_board
from tests.calibrate.two_cameras import REAL, T_RIGHT_LEFT

T_REAR_FRONT = pose(exp_so3(np.radians([2.0, -3.0, 25.0])), np.array([0.15, -0.4, 0.06]))
"""T_rear_front (4, 4) of the LiDARs."""
ON_FRONT = {
    "left": T_FORWARD,
    "right": T_RIGHT_LEFT @ T_FORWARD,
    "front": np.eye(4),
    "rear": T_REAR_FRONT,
}
"""Pose (4, 4) of the LiDAR `front` in each sensor's frame."""
SENSORS = tuple(ON_FRONT)


def make_rig(sensors=SENSORS, seed=None):
    """Build the profile of some of the sensors, with exact nominal poses.

    With a seed, lenses and board have errors with the standard deviations that the profile states.
    """
    rng = np.random.default_rng([seed or 0, 11])
    error = (lambda *size: rng.standard_normal(size)) if seed is not None else np.zeros
    sigma = {"focal_sigma_px": 3.0, "principal_point_sigma_px": 3.0, "distortion_sigma_px": 0.01}

    def lens():
        focal = 1 + sigma["focal_sigma_px"] / CAMERA.fx_px * error(1)[0]
        middle_px = sigma["principal_point_sigma_px"] * error(2)
        return {
            "model": "radtan",
            "fx_px": focal * CAMERA.fx_px,
            "fy_px": focal * CAMERA.fy_px,
            "cx_px": CAMERA.cx_px + middle_px[0],
            "cy_px": CAMERA.cy_px + middle_px[1],
            "distortion": list(CAMERA.distortion),
            **sigma,
        }

    square, plate_m = 1 + 1e-3 * error(1)[0], 1e-3 * error(2)
    cameras, lidars = (
        [name for name in sensors if name in names] for names in (("left", "right"), ("front", "rear"))
    )
    return Rig.model_validate(
        {
            "format_version": 1,
            "name": "four",
            "board": {
                "inner_corners": [BOARD.cols, BOARD.rows],
                "square_m": BOARD.square_m * square,
                "square_sigma_m": 1e-3 * BOARD.square_m,
                "width_m": BOARD.width_m + plate_m[0],
                "height_m": BOARD.height_m + plate_m[1],
                "plate_sigma_m": 1e-3,
                "pattern_offset_m": (1e-3 * error(2)).tolist(),
                "pattern_offset_sigma_m": 1e-3,
                "bow_sigma_m": 1e-4,
            },
            "lidars": {
                name: {"model": "VLP-16", "frame": f"{name}_link", "topic": f"/{name}"} for name in lidars
            },
            "cameras": {
                name: {
                    "frame": f"{name}_link",
                    "optical_frame": f"{name}_optical",
                    "resolution_px": [CAMERA.width_px, CAMERA.height_px],
                    "intrinsics": lens(),
                    "channels": {"frames": {"kind": "frames", "topic": f"/{name}/image_raw"}},
                }
                for name in cameras
            },
            "nominal_extrinsics": [
                {
                    "camera": first,
                    "lidar": second,
                    "matrix": between(first, second)[:3, :3].tolist(),
                    "translation_m": between(first, second)[:3, 3].tolist(),
                    "tolerance_deg": 5.0,
                    "tolerance_m": 0.1,
                }
                for first in sensors
                for second in lidars
                if first in cameras or (first, second) == ("front", "rear")
            ],
        }
    )


def between(first, second, poses=ON_FRONT):
    """True pose (4, 4) of the second sensor in the first one's frame."""
    return poses[first] @ invert(poses[second])


def error(result, poses=ON_FRONT):
    """Error (6,) of a result, used with the lenses that belong to it."""
    T = result.T_cam_lidar
    if result.intrinsics is not None:
        T = in_use(T, result.intrinsics)
    if result.lidar_intrinsics is not None:
        T = invert(in_use(invert(T), result.lidar_intrinsics))
    return difference(T, between(result.camera, result.lidar, poses))


def measure_errors(results):
    """Compute rms errors, deg and mm, and the share of errors within the 95 % regions; print them."""
    errors = [error(each) for each in results]
    chi2 = np.array([x @ np.linalg.solve(c.cov, x) for x, c in zip(errors, results, strict=True)])
    sizes = [[np.degrees(np.linalg.norm(x[3:])), 1e3 * np.linalg.norm(x[:3])] for x in errors]
    rms_deg, rms_mm = np.sqrt(np.mean(np.square(sizes), axis=0))
    covered = np.mean(chi2 < 12.59)
    print(f"{len(chi2)} poses: rms {rms_deg:.3f} deg, {rms_mm:.1f} mm; {covered:.1%} within 95 %")
    return rms_deg, rms_mm, covered


def simulate(n, seed, *, sensors=SENSORS, n_seeing=(2, 3), scenario=REAL, moves=None):
    """Simulate captures until each of n placements is seen by some of the sensors.

    Args:
        n: placements for each sensor, on average of two in three.
        seed: of everything.
        sensors: on the rig.
        n_seeing: numbers of sensors of a placement; all where there are fewer.
        scenario: noise.
        moves: sensor -> function of a capture's number to its pose on the LiDAR `front`, where it moves.
    """
    rng, moves = np.random.default_rng([seed, 7]), moves or {}
    bias_m = dict.fromkeys(sensors, 0.0)
    for k, name in enumerate(name for name in sensors if name in ("front", "rear")):
        of_lasers = scenario.laser_bias_sigma_m * np.random.default_rng([seed, k]).standard_normal(16)
        bias_m[name] = of_lasers - of_lasers.mean() + scenario.range_offset_m
    found = {name: {} for name in sensors}
    for number in range(n):
        seen = {}
        while len(seen) < len(sensors):
            T_front_board = invert(T_FORWARD) @ random_pose(rng, scenario, BOARD)
            seen = {}
            for name in sensors:
                T = moves.get(name, lambda k, name=name: ON_FRONT[name])(number) @ T_front_board
                is_lidar = name in ("front", "rear")
                board = scan_board(T, rng, scenario, BOARD, bias_m[name]) if is_lidar else None
                board = (
                    [board]
                    if board is not None
                    else None
                    if is_lidar
                    else photograph(T, rng, scenario, BOARD)
                )
                if board is not None:
                    seen[name] = board
        for name in rng.permutation(list(sensors))[: rng.choice(n_seeing)]:
            found[name][f"{number:06d}"] = seen[name]
    images = {(name, "frames"): each for name, each in found.items() if name in ("left", "right")}
    return Detections(images, {name: each for name, each in found.items() if name in ("front", "rear")})
