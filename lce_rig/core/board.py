"""The calibration board: a checkerboard printed on a larger rectangular plate."""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.geometry import Array


@dataclass(frozen=True)
class Board:
    """A checkerboard on a plate.

    Frame board: origin at the centre of the plate, x along its width, y up along its height (as the print is
    looked at), z out of the print towards the viewer.

    Attributes:
        cols: inner corners along the width.
        rows: inner corners along the height.
        square_m: side of one square.
        width_m: outer width of the plate.
        height_m: outer height of the plate.
        pattern_offset_m: (x, y) of the pattern's centre from the plate's centre, frame board.
    """

    cols: int
    rows: int
    square_m: float
    width_m: float
    height_m: float
    pattern_offset_m: tuple[float, float] = (0.0, 0.0)

    @property
    def is_symmetric(self) -> bool:
        """Whether the pattern turned by 180 deg gives the same picture (squares add up to an even number)."""
        return (self.cols + self.rows) % 2 == 0

    def corners(self) -> Array:
        """List the inner corners, row by row from the top left as the print is looked at.

        Returns:
            (rows * cols, 3) in frame board, m.
        """
        x = (np.arange(self.cols) - (self.cols - 1) / 2) * self.square_m + self.pattern_offset_m[0]
        y = ((self.rows - 1) / 2 - np.arange(self.rows)) * self.square_m + self.pattern_offset_m[1]
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)], axis=1)

    def outline(self) -> Array:
        """List the plate's four corners, counter-clockwise from the lower left as the print is looked at.

        Returns:
            (4, 3) in frame board, m.
        """
        w, h = self.width_m / 2, self.height_m / 2
        return np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]], dtype=np.float64)

    def edges(self) -> tuple[Array, Array]:
        """Describe the plate's edges: bottom, right, top, left.

        Returns:
            A point on each edge (4, 3) and each edge's outward in-plane normal (4, 3), frame board.
        """
        outline = self.outline()
        midpoints = (outline + np.roll(outline, -1, axis=0)) / 2
        normals = np.array([[0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]], dtype=np.float64)
        return midpoints, normals
