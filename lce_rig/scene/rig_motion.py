"""Motion of a rig while it records: edges at the time of an image, and consistency of the clocks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array, exp_so3, log_so3
from lce_rig.core.interrupts import without_interrupt
from lce_rig.scene.estimate import MIN_GAIN
from lce_rig.scene.outline_score import N_BLOCKS, OutlineScore, OutlineView

# Motion limits of a standing rig over 0.1 s, beyond noise and people passing by.
_STILL_MPS, _STILL_RAD_S = 0.2, np.radians(1.5)
_LONGEST_GAP_S = 0.5
_VOXEL_M = 0.15
_REACH_M = 4 * _VOXEL_M  # of the first round of matching
_ROBUST_M = 0.1  # Residuals above this have little weight: people and cars move differently.
_MIN_FITNESS = 0.5
_NORMALS_M = 0.8
_LATEST_S = 0.15  # of images after their timestamps, or before
_CLOCKS_S = np.linspace(-_LATEST_S, _LATEST_S, 31)
# Smallest time offset not explained by slightly varying motion, s.
_APART_S = 0.02
_APART_SIGMAS = 3.0
# Fraction of the score below which clocks explain images less well than changed extrinsics.
_NEARLY = 0.1


@dataclass(frozen=True, eq=False)
class RigMotion:
    """Constant velocity of a LiDAR, in its own frame.

    Attributes:
        velocity_mps: (3,).
        rate_rad_s: (3,) rotation.
    """

    velocity_mps: Array
    rate_rad_s: Array

    @property
    def is_still(self) -> bool:
        """Whether the motion is too slow to be significant."""
        return bool(
            np.linalg.norm(self.velocity_mps) < _STILL_MPS and np.linalg.norm(self.rate_rad_s) < _STILL_RAD_S
        )

    def moved(self, points: Array, after_s: Array) -> Array:
        """Return static points as the LiDAR would measure them some time later.

            p' = exp(w dt)^T (p - v dt)

        Args:
            points: (N, 3) m, frame lidar at the time that each was seen.
            after_s: (N,) from then to the time wanted.
        """
        shifted = points - after_s[:, None] * self.velocity_mps
        turns = exp_so3(-after_s[:, None] * self.rate_rad_s)
        return np.asarray(np.einsum("nij,nj->ni", turns, shifted))


def estimate_motion(previous: Scan, scan: Scan) -> RigMotion | None:
    """Estimate a rig's motion from two consecutive scans: point-to-plane ICP with a robust loss.

    In a corridor the speed along it is undetermined.

    Returns:
        None where the scans have no timestamps, are not consecutive, or do not match.

    References:
        S. Rusinkiewicz and M. Levoy, Efficient variants of the ICP algorithm, 3DIM 2001.
    """
    if previous.stamp_ns is None or scan.stamp_ns is None:
        return None
    gap_s = 1e-9 * (scan.stamp_ns - previous.stamp_ns)
    if not 0 < gap_s < _LONGEST_GAP_S:
        return None
    with without_interrupt():
        import open3d as o3d
    register = o3d.pipelines.registration
    arrays = (np.asarray(each.points, dtype=np.float64) for each in (previous, scan))
    clouds = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in arrays)
    target, source = (cloud.voxel_down_sample(_VOXEL_M) for cloud in clouds)
    if min(len(target.points), len(source.points)) < 100:
        return None
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(_NORMALS_M, 20))
    loss = register.TransformationEstimationPointToPlane(register.TukeyLoss(_ROBUST_M))
    T_previous_scan = np.eye(4)
    for reach_m in (_REACH_M, 2 * _ROBUST_M):
        found = register.registration_icp(
            source, target, reach_m, T_previous_scan, loss, register.ICPConvergenceCriteria(1e-5, 1e-5, 20)
        )
        T_previous_scan = np.asarray(found.transformation)
    if found.fitness < _MIN_FITNESS:
        return None
    return RigMotion(T_previous_scan[:3, 3] / gap_s, log_so3(T_previous_scan[:3, :3]) / gap_s)


def firing_times_s(scan: Scan, points: Array) -> Array | None:
    """Compute the time of points (N, 3) in or near a scan, s after its first firing."""
    from scipy.spatial import cKDTree

    if scan.offset_ns is None or not len(scan.points):
        return None
    _, nearest = cKDTree(scan.points).query(points)
    chosen: NDArray[np.intp] = np.asarray(nearest, dtype=np.intp)
    return np.asarray(1e-9 * scan.offset_ns[chosen], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class MovingView:
    """A capture of a moving rig, its edges at the image's time, and the motion."""

    view: OutlineView
    motion: RigMotion


def clocks_apart_s(
    views: Sequence[MovingView], intrinsics: Intrinsics, T_cam_lidar: Array, T_changed: Array | None = None
) -> float | None:
    """Estimate the delay of images after their timestamps, from captures of a moving rig.

    The score is searched along the time of the images, at the finest width of the fields.

    Args:
        views: the captures.
        intrinsics: intrinsics of the camera.
        T_cam_lidar: (4, 4) deployed.
        T_changed: (4, 4) changed extrinsics that explain the images otherwise.

    Returns:
        None if the edges fit without a delay, the motion is too slow, or changed extrinsics explain the
        images better.
    """
    rows = []
    for after_s in _CLOCKS_S:
        later = []
        for each in views:
            outlines = each.view.outlines
            points = each.motion.moved(outlines.points, np.full(len(outlines), after_s))
            later.append(replace(each.view, outlines=replace(outlines, points=points)))
        score = OutlineScore.finest(later, intrinsics, T_cam_lidar)
        rows.append(score.edges(np.zeros(6))[0])
    at_once = OutlineScore.finest([each.view for each in views], intrinsics, T_cam_lidar)
    block = at_once.blocks(at_once.edges(np.zeros(6))[2])
    by_block = np.array([np.bincount(block, row, N_BLOCKS) for row in rows])[:, np.unique(block)]
    total = by_block.sum(axis=1)
    if T_changed is not None:
        changed = OutlineScore.finest([each.view for each in views], intrinsics, T_changed)
        if total.max() < (1 - _NEARLY) * changed.value(np.zeros(6)):
            return None
    peak_s = float(_peaks(total[:, None])[0])
    n = by_block.shape[1]
    without = _peaks(total[:, None] - by_block)  # jackknife over the blocks of the image
    sigma_s = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    gains = by_block[total.argmax()] - by_block[len(_CLOCKS_S) // 2]
    significance = gains.sum() / max(np.linalg.norm(gains), 1e-12)
    is_apart = abs(peak_s) > max(_APART_S, _APART_SIGMAS * sigma_s)
    return peak_s if is_apart and significance > MIN_GAIN else None


def _peaks(columns: Array) -> Array:
    """Find the time of the highest value of each column (K, N), between grid points by a parabola."""
    index = np.clip(columns.argmax(axis=0), 1, len(_CLOCKS_S) - 2)
    before, at, after = (columns[index + shift, np.arange(columns.shape[1])] for shift in (-1, 0, 1))
    bend = np.minimum(before - 2 * at + after, -1e-12)
    step = np.clip(0.5 * (before - after) / bend, -1, 1)
    return np.asarray(_CLOCKS_S[index] + step * (_CLOCKS_S[1] - _CLOCKS_S[0]))
