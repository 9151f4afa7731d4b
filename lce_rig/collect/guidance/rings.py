"""Which rings of a LiDAR cross a board, and where they enter and leave it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.collect.guidance.sensors import SensorModel
from lce_rig.core.geometry import Array

# The detector does not use shorter rings as lines.
FEWEST_POINTS = 6
_SAMPLES = 48


@dataclass(frozen=True, eq=False)
class Rings:
    """The rings of L lasers on N boards.

    Attributes:
        n_points: (N, L) points of each ring on the board; 0 where the ring is too short to be used.
        ends: (N, L, 2, 2) where it enters and leaves the board, x and y of frame board, m.
        spacing_m: (N, L) distance of neighbouring points on the board.
        edge: (N, L, 2) the edge nearest to each end: 0 bottom, 1 right, 2 top, 3 left.
    """

    n_points: Array
    ends: Array
    spacing_m: Array
    edge: NDArray[np.intp]

    @property
    def n_rings(self) -> NDArray[np.intp]:
        """Rings on each board (N,)."""
        return np.asarray(np.count_nonzero(self.n_points, axis=1))


def cross_board(model: SensorModel, T_lidar_board: Array) -> Rings:
    """Find where the rings cross boards.

    A laser at elevation a sees at azimuth h the point s u of the plane n . p = n . c, with
    u = (cos a cos h, cos a sin h, sin a) and s = n . c / n . u. Samples over the board's azimuths show where
    it lies within the plate.

    Args:
        model: the sensors.
        T_lidar_board: (N, 4, 4).
    """
    board, axes, centre = model.board, T_lidar_board[:, :3, :3], T_lidar_board[:, :3, 3]
    azimuth, span = _azimuths(model, T_lidar_board)
    level, rise = np.cos(model.elevations_rad), np.sin(model.elevations_rad)
    # Dot products of each ray with the three axes of each board, (N, 3, L, K).
    around = np.cos(azimuth)[:, None] * axes[:, 0, :, None] + np.sin(azimuth)[:, None] * axes[:, 1, :, None]
    along = level[:, None] * around[:, :, None, :] + (rise[:, None] * axes[:, 2, :, None, None])
    to_centre = np.einsum("nji,nj->ni", axes, centre)
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = to_centre[:, 2, None, None] / along[:, 2]
        xy = range_m[:, None] * along[:, :2] - to_centre[:, :2, None, None]
    half = np.array([board.width_m, board.height_m]) / 2
    is_hit = (range_m > 0) & np.all(np.abs(xy) <= half[:, None, None], axis=1)

    n_hit = is_hit.sum(axis=-1)
    first = is_hit.argmax(axis=-1)
    last = is_hit.shape[-1] - 1 - is_hit[..., ::-1].argmax(axis=-1)
    n_points = n_hit * (span / _SAMPLES)[:, None] / model.azimuth_step_rad
    n_points = np.where(n_points >= FEWEST_POINTS, n_points, 0.0)
    outer = np.stack([first, last], axis=-1)
    ends = np.take_along_axis(xy, outer[:, None], axis=-1).transpose(0, 2, 3, 1)
    # A sample stands for what lies half a sample to either side of it.
    chord = ends[:, :, 1] - ends[:, :, 0]
    beyond = chord / np.maximum(n_hit - 1, 1)[..., None] / 2
    ends = np.stack([ends[:, :, 0] - beyond, ends[:, :, 1] + beyond], axis=2)
    ends = np.where((n_points > 0)[..., None, None], ends, 0.0)
    length_m = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    spacing_m = length_m / np.maximum(n_points, 1)
    return Rings(n_points, ends, spacing_m, board.nearest_edge(ends))


def _azimuths(model: SensorModel, T_lidar_board: Array) -> tuple[Array, Array]:
    """Spread samples (N, K) over the azimuths of each plate; also their span (N,)."""
    outline = np.einsum("nij,kj->nki", T_lidar_board[:, :3, :3], model.board.outline())
    outline += T_lidar_board[:, None, :3, 3]
    middle = np.arctan2(T_lidar_board[:, 1, 3], T_lidar_board[:, 0, 3])
    turned = np.arctan2(outline[..., 1], outline[..., 0]) - middle[:, None]
    turned = np.angle(np.exp(1j * turned))
    low, span = turned.min(axis=1), np.ptp(turned, axis=1)
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return (middle + low)[:, None] + span[:, None] * share, span
