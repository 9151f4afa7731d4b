"""The pattern of a board: its black areas, and the positions of its markers."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array

DICTIONARIES = (
    *(f"{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)),
    *("ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11"),
)
"""OpenCV's dictionaries of markers, without DICT_."""
LEAST_CORNERS = 8
"""Least number of corners in an image of a board with markers; fewer make a poor pose."""
# Kalibr's tags have a black border of two modules, other markers of one.
_BORDER = {"charuco": 1, "aprilgrid": 2}
# Tag 0 of AprilTag's family 36h11 as its authors draw it, from the upper left row by row. OpenCV's releases
# differ by half a turn.
_TAG36H11_0 = 0xD5D628584


@dataclass(frozen=True, eq=False)
class Markers:
    """The markers of a board.

    Attributes:
        ids: (M,).
        corners: (M, 4, 3) of each marker, clockwise from its upper left facing the pattern, frame board, m.
        cells: (M, 2) column and row of the corner of `Board.corners()` below and right of a ChArUco marker's
            square, and of the upper left corner of an AprilGrid's tag.
        is_white: (M, n, n) the modules with their black border, row by row from the upper left.
    """

    ids: NDArray[np.intp]
    corners: Array
    cells: NDArray[np.intp]
    is_white: NDArray[np.bool_]


@lru_cache(maxsize=16)
def markers_of(board: Board, *, is_legacy: bool = False) -> Markers:
    """List the markers of a ChArUco board or an AprilGrid.

    Args:
        board: board with markers.
        is_legacy: place the markers of a ChArUco board as OpenCV before 4.6 did: the upper left square is
            white if the number of rows is even.
    """
    s, (x0, y0) = board.square_m, board.pattern_offset_m
    if board.type == "charuco":
        # Squares (column, row) from the upper left, which is black: the white ones have markers.
        shift = board.rows % 2 if is_legacy else 0
        row, column = (index.ravel() for index in np.indices((board.rows + 1, board.cols + 1)))
        keep = (row + column + shift) % 2 == 1
        row, column, side = row[keep], column[keep], board.marker_share * s
        x = x0 + (column - board.cols / 2) * s
        y = y0 + (board.rows / 2 - row) * s
        cells = np.stack([column, row], axis=1)
    else:
        # Tags are numbered from the lower left.
        up, column = (index.ravel() for index in np.indices((board.rows // 2, board.cols // 2)))
        row, side = board.rows // 2 - 1 - up, s
        pitch = (1 + board.gap_share) * s
        x = x0 + (column - (board.cols // 2 - 1) / 2) * pitch
        y = y0 + (up - (board.rows // 2 - 1) / 2) * pitch
        cells = np.stack([2 * column, 2 * row], axis=1)
    around = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * side / 2
    corners = np.zeros((len(x), 4, 3))
    corners[..., :2] = np.stack([x, y], axis=1)[:, None] + around
    ids = board.first_id + np.arange(len(x))
    is_white = np.pad(modules(board.dictionary, ids), [(0, 0), *[(_BORDER[board.type],) * 2] * 2])
    return Markers(ids, corners, cells, is_white)


def modules(dictionary: str, ids: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Find the white modules (M, n, n) of markers, without border, row by row from the upper left."""
    import cv2

    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    n = book.markerSize
    drawn = np.array([cv2.aruco.generateImageMarker(book, int(number), n + 2) for number in (0, *ids)])
    is_white = drawn[:, 1:-1, 1:-1] > 127
    if dictionary == "APRILTAG_36h11":
        first = np.array([_TAG36H11_0 >> (35 - k) & 1 for k in range(36)], dtype=bool).reshape(6, 6)
        is_white = is_white if np.array_equal(is_white[0], first) else is_white[:, ::-1, ::-1]
    return np.asarray(is_white[1:])


def n_markers_of(dictionary: str) -> int:
    """Count the markers of a dictionary."""
    import cv2

    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")).bytesList)


def is_dark(board: Board, xy_m: Array) -> NDArray[np.bool_]:
    """Find which points (..., 2) in the board's plane are printed black.

    The outer square at the top left of a checkerboard or ChArUco board is black. The squares between an
    AprilGrid's tags turn every corner of a tag into a crossing.

    Args:
        board: the board.
        xy_m: (..., 2) x and y, frame board.
    """
    if board.type == "plain":
        return np.zeros(xy_m.shape[:-1], dtype=np.bool_)
    # Position right and down from the pattern's upper left corner.
    width_m, height_m = board.pattern_size_m
    right = (xy_m[..., 0] - board.pattern_offset_m[0] + width_m / 2) / board.square_m
    down = (board.pattern_offset_m[1] - xy_m[..., 1] + height_m / 2) / board.square_m
    inside = (right >= 0) & (right < width_m / board.square_m) & (down >= 0)
    inside &= down < height_m / board.square_m
    if board.type != "aprilgrid":
        column, row = np.floor(right), np.floor(down)
        dark = (column + row) % 2 == 0
        if board.type == "charuco":
            margin = (1 - board.marker_share) / 2
            dark |= _in_marker(
                board,
                (column, row),
                ((right - column - margin) / board.marker_share, (down - row - margin) / board.marker_share),
            )
        return np.asarray(inside & dark)
    pitch, gap = 1 + board.gap_share, board.gap_share
    column, row = np.floor(right / pitch), np.floor(down / pitch)
    u, v = right - column * pitch - gap, down - row * pitch - gap
    dark = ((u < 0) & (v < 0)) | _in_marker(board, (2 * column, 2 * row), (u, v))
    return np.asarray(inside & dark)


def dark_rectangles(board: Board) -> Array:
    """List the black parts of the pattern as (K, 4) left, lower, width and height, frame board, m."""
    s, (x0, y0) = board.square_m, board.pattern_offset_m
    width_m, height_m = board.pattern_size_m
    left, upper = x0 - width_m / 2, y0 + height_m / 2
    squares = []
    if board.type == "aprilgrid":
        pitch, gap = (1 + board.gap_share) * s, board.gap_share * s
        for row in range(board.rows // 2 + 1):
            squares += [
                (left + k * pitch, upper - row * pitch - gap, gap, gap) for k in range(board.cols // 2 + 1)
            ]
    else:
        for row in range(board.rows + 1):
            squares += [
                (left + k * s, upper - (row + 1) * s, s, s) for k in range(row % 2, board.cols + 1, 2)
            ]
    markers = markers_of(board) if board.has_markers else None
    for corners, is_white in [] if markers is None else zip(markers.corners, markers.is_white, strict=True):
        side = (corners[1, 0] - corners[0, 0]) / len(is_white)
        for row, black in enumerate(~is_white):
            # Runs of black modules, without seams.
            ends = np.flatnonzero(np.diff(np.concatenate([[False], black, [False]])))
            squares += [
                (corners[0, 0] + first * side, corners[0, 1] - (row + 1) * side, (last - first) * side, side)
                for first, last in zip(ends[::2], ends[1::2], strict=True)
            ]
    return np.array(squares, dtype=np.float64)


def _in_marker(board: Board, cells: tuple[Array, Array], places: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Find which positions (0..1 right and down in the marker of a cell) are black."""
    markers = markers_of(board)
    table = np.full((board.rows + 2, board.cols + 2), -1)
    table[markers.cells[:, 1], markers.cells[:, 0]] = np.arange(len(markers.ids))
    column, row = (
        np.clip(cell, -1, n + 1).astype(np.intp)
        for cell, n in zip(cells, (board.cols, board.rows), strict=True)
    )
    marker, n = table[row, column], markers.is_white.shape[1]
    u, v = (np.floor(np.clip(place, -1, 2) * n).astype(np.intp) for place in places)
    is_in = (marker >= 0) & (u >= 0) & (u < n) & (v >= 0) & (v < n)
    return np.asarray(is_in & ~markers.is_white[marker, np.clip(v, 0, n - 1), np.clip(u, 0, n - 1)])
