"""The board's outline in the image, to be drawn where the board is and where it should be."""

import numpy as np

from lce_rig.collect.guidance.sensor_noise import SensorModel
from lce_rig.core.geometry import Array, transform


def outline_px(model: SensorModel, T_cam_board: Array, points_per_edge: int = 12) -> Array:
    """Project the plate's border as a closed polygon; lenses bend its edges.

    Args:
        model: the camera and the board.
        T_cam_board: (4, 4).
        points_per_edge: of the polygon.

    Returns:
        (4 points_per_edge + 1, 2) px, the last point the first; NaN where a point is out of the lens's sight.
    """
    corners = model.board.outline()
    share = np.arange(points_per_edge)[:, None] / points_per_edge
    edges = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    border = np.concatenate([*edges, corners[:1]])
    pixels, _ = model.lens.project(transform(T_cam_board, border))
    return pixels
