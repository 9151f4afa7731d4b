"""Poses of all sensors of a rig relative to the base sensor, composed from the calibrated pairs."""

from collections.abc import Collection, Sequence

import numpy as np

from lce_rig.core.calibration import Calibration, RigPoses, SensorPose, Verdict
from lce_rig.core.geometry import Array, composition_slopes, relative_pose, sigma_sizes

_VERDICTS: tuple[Verdict, ...] = ("pass", "marginal")
# Minimum number of sensors for a list of poses: a pair already has its pose.
_FEWEST_SENSORS = 3


def find_rig_poses(pairs: Sequence[Calibration], lidars: Collection[str]) -> RigPoses | None:
    """Compose each sensor's pose relative to the base sensor, along the shortest chain of pairs.

    Among equally short chains, the pairs with the better verdict are used. Failed pairs are skipped. Errors
    of successive pairs are treated as independent.

    Args:
        pairs: the results of a session.
        lidars: LiDARs of the profile; the first one with a result is the base.

    Returns:
        The poses, of LiDARs in the order of the profile, then of cameras; None for two sensors.
    """
    held = dict.fromkeys(name for c in pairs for name in (c.camera, c.lidar))
    names = [name for name in lidars if name in held]
    names += [name for name in held if name not in names]
    if len(names) < _FEWEST_SENSORS:
        return None
    base = names[0]
    usable = [c for c in pairs if c.verdict in _VERDICTS]
    usable.sort(key=lambda c: _VERDICTS.index(c.verdict))
    placed: dict[str, tuple[Array, Array, int]] = {base: (np.eye(4), np.zeros((6, 6)), 0)}
    latest = [base]
    while latest:
        before, latest = latest, []
        for c in usable:
            known = next((name for name in (c.camera, c.lidar) if name in before), None)
            other = c.lidar if known == c.camera else c.camera
            if known is None or other in placed:
                continue
            T_base_known, cov_known, worst = placed[known]
            T_known_other, cov_step = _pose_on(c, known)
            by_known, by_step = composition_slopes(T_base_known, T_known_other)
            cov = by_known @ cov_known @ by_known.T + by_step @ cov_step @ by_step.T
            verdict = max(worst, _VERDICTS.index(c.verdict))
            placed[other] = T_base_known @ T_known_other, cov, verdict
            latest.append(other)
    poses = []
    for name in names:
        if name in placed and name != base:
            T, cov, verdict = placed[name]
            poses.append(SensorPose(name, T, *sigma_sizes(cov), _VERDICTS[verdict]))
    return RigPoses(base, tuple(poses))


def _pose_on(c: Calibration, sensor: str) -> tuple[Array, Array]:
    """Return the pose (4, 4) of a pair's other sensor in this one's frame, and its covariance (6, 6)."""
    if sensor == c.camera:
        return c.T_cam_lidar, c.cov
    T, J = relative_pose(np.eye(4), c.T_cam_lidar)
    return T, np.asarray(J[:, 6:] @ c.cov @ J[:, 6:].T)
