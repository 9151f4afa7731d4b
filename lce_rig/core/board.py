"""The calibration board: a pattern printed on a larger rectangular plate."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

BoardType = Literal["checkerboard", "charuco", "aprilgrid", "plain"]


@dataclass(frozen=True)
class Board:
    """A pattern on a plate: a checkerboard, a ChArUco board (OpenCV), an AprilGrid (Kalibr), or none.

    A plain plate has no corners and squares of no size. Only LiDARs detect its pose.

    Frame board: origin at the centre of the plate, x along its width, y up along its height (as the pattern
        is
    looked at), z out of the pattern towards the viewer.

    Attributes:
        cols: columns of corners along the width: of inner corners, or of the corners of tags.
        rows: rows of corners along the height.
        square_m: side of one square, or of one tag.
        width_m: outer width of the plate.
        height_m: outer height of the plate.
        pattern_offset_m: (x, y) of the pattern's centre from the plate's centre, frame board.
        type: type of the pattern.
        marker_share: side of a ChArUco board's markers over that of its squares.
        gap_share: gap between the tags of an AprilGrid over their side.
        dictionary: dictionary of the markers, OpenCV's name without DICT_.
        first_id: id of the first marker: top left of a ChArUco board, lower left of an AprilGrid.
    """

    cols: int
    rows: int
    square_m: float
    width_m: float
    height_m: float
    pattern_offset_m: tuple[float, float] = (0.0, 0.0)
    type: BoardType = "checkerboard"
    marker_share: float = 0.0
    gap_share: float = 0.0
    dictionary: str = ""
    first_id: int = 0

    @property
    def has_markers(self) -> bool:
        """Whether each corner is identified, so that part of the pattern may be hidden."""
        return self.type in ("charuco", "aprilgrid")

    @property
    def n_markers(self) -> int:
        """Number of markers; half of a ChArUco board's squares have one."""
        return (
            self.cols * self.rows // 4 if self.type == "aprilgrid" else (self.cols + 1) * (self.rows + 1) // 2
        )

    @property
    def summary(self) -> str:
        """Describe the pattern, such as "9x7 squares of 70 mm"."""
        if self.type == "plain":
            return f"plain plate of {self.width_m:g} x {self.height_m:g} m"
        if self.type == "aprilgrid":
            return f"{self.cols // 2}x{self.rows // 2} tags of {1e3 * self.square_m:g} mm"
        return f"{self.cols + 1}x{self.rows + 1} squares of {1e3 * self.square_m:g} mm"

    @property
    def is_symmetric(self) -> bool:
        """Whether the pattern looks the same rotated by 180 deg (rows and columns of squares sum to even)."""
        return not self.has_markers and (self.cols + self.rows) % 2 == 0

    @property
    def pattern_size_m(self) -> tuple[float, float]:
        """Width and height of the pattern, with the outer squares, or an AprilGrid's small corner squares."""
        if self.type != "aprilgrid":
            return (self.cols + 1) * self.square_m, (self.rows + 1) * self.square_m
        gap = self.gap_share
        width, height = ((n // 2 * (1 + gap) + gap) * self.square_m for n in (self.cols, self.rows))
        return width, height

    def corners(self) -> Array:
        """List the inner corners, row by row from the top left as seen by the viewer.

        Returns:
            (rows * cols, 3) in frame board, m.
        """
        x = self._places(self.cols) * self.square_m + self.pattern_offset_m[0]
        y = self._places(self.rows)[::-1] * self.square_m + self.pattern_offset_m[1]
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)], axis=1)

    def _places(self, n: int) -> Array:
        """Return the positions of n columns or rows of corners about the pattern's centre."""
        place = np.arange(n, dtype=np.float64)
        if self.type == "aprilgrid":
            place = place // 2 * (1 + self.gap_share) + place % 2
        return np.asarray(place - place[-1] / 2, dtype=np.float64)

    def outline(self) -> Array:
        """List the plate's four corners, counter-clockwise from the lower left as seen by the viewer.

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

    def nearest_edge(self, xy_m: Array) -> NDArray[np.intp]:
        """Return the index of the edge nearest to each point in the board's plane, in the order of `edges`.

        Beyond a corner two edges are equally near: the bottom or the top edge is returned.

        Args:
            xy_m: (..., 2) x and y, frame board; further coordinates are ignored.

        Returns:
            (...): 0 bottom, 1 right, 2 top, 3 left.
        """
        inside_x, inside_y = self._inside(xy_m)
        right_or_left = 3 - 2 * (xy_m[..., 0] > 0).astype(np.int8)
        top_or_bottom = 2 * (xy_m[..., 1] > 0).astype(np.int8)
        is_side = (inside_y > 0) & (inside_x < inside_y)
        return np.where(is_side, right_or_left, top_or_bottom).astype(np.intp)

    def inside_nearest_edge(self, xy_m: Array) -> Array:
        """Compute how far points lie inside the edge given by `nearest_edge`, m.

        Args:
            xy_m: (..., 2) x and y, frame board; further coordinates are ignored.
        """
        inside_x, inside_y = self._inside(xy_m)
        return np.where((inside_y > 0) & (inside_x < inside_y), inside_x, inside_y)

    def _inside(self, xy_m: Array) -> tuple[Array, Array]:
        """Compute how far points lie inside the left or right edge, and the lower or upper edge, m."""
        return self.width_m / 2 - np.abs(xy_m[..., 0]), self.height_m / 2 - np.abs(xy_m[..., 1])

    def outline_distance(self, xy_m: Array) -> Array:
        """Compute the distance of points in the board's plane from the outline, m.

        Args:
            xy_m: (..., 2) x and y, frame board; further coordinates are ignored.
        """
        beyond = np.abs(xy_m[..., :2]) - [self.width_m / 2, self.height_m / 2]
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
        return np.asarray(outside - np.minimum(beyond.max(axis=-1), 0))
