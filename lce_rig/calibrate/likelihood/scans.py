"""The LiDAR's returns from the boards of all captures, stacked for vectorised sums.

A spinning LiDAR sends its beams from a lens beside its axis, and drivers that do not know where place
points as if they came from the axis. With e_a the direction of growing azimuth and alpha the elevation, a
point lies at

    p + lateral e_a + vertical alpha e_z                                                                  (1)

instead of p.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.background import describe_background
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard

Indices = NDArray[np.intp]
N_FIELDS = 2
# Half a beam's width, and what the outline found in the scan may be off by.
_BORDER_M = 0.02


@dataclass(frozen=True, eq=False)
class StackedScans:
    """Rays of F captures: N returns from boards, ordered by capture and ring, and M ring ends.

    Attributes:
        n_captures: F.
        rings: (L,) ring numbers that occur.
        capture, ring: (N,) of each return; `ring` is an index into `rings`.
        rays: (N, 3) unit vectors, frame lidar.
        range_m: (N,).
        fields: (N, 3, 2) displacement by (1) for a lateral offset of 1 m, a vertical one of 1 m per rad.
        end_capture: (M,) of each ring end.
        end_rays: (M, 3) unit vectors towards it.
        next_rays: (M, 3) unit vectors of the firing after it, which missed the board.
        end_fields: (M, 3, 2) as `fields`.
        end_background: (M, 3) what is behind it, `describe_background`.
    """

    n_captures: int
    rings: NDArray[np.int16]
    capture: Indices
    ring: Indices
    rays: Array
    range_m: Array
    fields: Array
    end_capture: Indices
    end_rays: Array
    next_rays: Array
    end_fields: Array
    end_background: Array

    @property
    def group(self) -> Indices:
        """Index (N,) of each return's pair of capture and ring, of F L in all; ascending."""
        return self.capture * len(self.rings) + self.ring


def interior(lidar: LidarBoard, board: Board) -> LidarBoard:
    """Leave out returns near the border: there the beam meets what is behind as well, and reads too long."""
    T = lidar.T_lidar_board
    xy = ((np.asarray(lidar.points, dtype=np.float64) - T[:3, 3]) @ T[:3, :3])[:, :2]
    keep = np.all(np.abs(xy) < np.array([board.width_m, board.height_m]) / 2 - _BORDER_M, axis=1)
    if np.count_nonzero(keep) < len(keep) / 2:
        return lidar
    offset_ns = None if lidar.offset_ns is None else lidar.offset_ns[keep]
    return replace(lidar, points=lidar.points[keep], ring=lidar.ring[keep], offset_ns=offset_ns)


def stack_scans(boards: Sequence[LidarBoard]) -> StackedScans:
    """Stack the boards of F captures."""
    rings = np.unique(np.concatenate([board.ring for board in boards]))
    capture = np.repeat(np.arange(len(boards)), [len(board.points) for board in boards])
    ring = np.searchsorted(rings, np.concatenate([board.ring for board in boards]))
    points = np.concatenate([np.asarray(board.points, dtype=np.float64) for board in boards])
    order = np.lexsort((ring, capture))
    points, capture, ring = points[order], capture[order], ring[order]
    range_m = np.linalg.norm(points, axis=1)
    ends = np.concatenate([np.asarray(b.edge_points, dtype=np.float64).reshape(-1, 3) for b in boards])
    angle = np.concatenate([board.edge_side * board.azimuth_step_rad for board in boards])
    end_rays = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    return StackedScans(
        n_captures=len(boards),
        rings=rings,
        capture=capture,
        ring=ring,
        rays=points / range_m[:, None],
        range_m=range_m,
        fields=lens_fields(points),
        end_capture=np.repeat(np.arange(len(boards)), [len(board.edge_points) for board in boards]),
        end_rays=end_rays,
        next_rays=turn_about_z(end_rays, angle),
        end_fields=lens_fields(ends),
        end_background=np.concatenate([describe_background(board) for board in boards]),
    )


def turn_about_z(vectors: Array, angle_rad: Array) -> Array:
    """Turn vectors (M, 3) about the z axis by angles (M,)."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    x = cosine * vectors[:, 0] - sine * vectors[:, 1]
    y = sine * vectors[:, 0] + cosine * vectors[:, 1]
    return np.stack([x, y, vectors[:, 2]], axis=1)


def lens_fields(points: Array) -> Array:
    """Compute the displacements (1) of points (N, 3), frame lidar: (N, 3, 2)."""
    across = np.hypot(points[:, 0], points[:, 1])
    fields = np.zeros((len(points), 3, N_FIELDS))
    fields[:, 0, 0], fields[:, 1, 0] = -points[:, 1] / across, points[:, 0] / across
    fields[:, 2, 1] = np.arctan2(points[:, 2], across)
    return fields
