"""Inner corners of a checkerboard in a grey image, in the order of `Board.corners()`."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.detect.image.saddle import Crossings, fit_crossings, sample

Grey = NDArray[np.uint8]

# Image width, px, below which images are first searched at twice their size, above at half: the finders need
# squares of 10 to 60 px.
_WIDE_PX = 700
_SEARCH_PX = 640
_MOST_SCALE = 1.5
# Number of saddle points examined, and approximate reach of their edges, px of the searched image.
_MOST_SADDLES = 220
_SADDLE_SIGMA_PX = 1.2
# Minimum cosine of the angle between a corner's edge and the direction to its neighbour.
_ALONG = 0.94
# Maximum ratios between neighbours: strength of their saddles, spacing along a row.
_MOST_STRONGER = 2.5
_MOST_LONGER = 1.7
_WAYS = ((1, 0), (0, 1), (-1, 0), (0, -1))
_SB_THOROUGH = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE


def find_grid(grey: Grey, board: Board, *, is_thorough: bool = True) -> Crossings | None:
    """Find the inner corners with sub-pixel accuracy, trying the cheapest method first.

    Args:
        grey: (H, W).
        board: defines the number and order of the inner corners.
        is_thorough: whether to continue after the quick attempts, which take a tenth of the total time.

    Returns:
        The crossings, `grid_px` in the order of `Board.corners()`; None if no attempt finds all of them.
    """
    width = grey.shape[1]
    scale = _SEARCH_PX / width if width > _WIDE_PX else 1.0
    lattice = crossing_lattice(grey, (board.cols, board.rows), scale)
    if lattice is not None:
        ordered = order_corners(grey, lattice, board)
        crossings = fit_crossings(grey, ordered.reshape(board.rows, board.cols, 2))
        if crossings.is_fitted.all():
            return crossings
    seen = seen_grid(grey)
    if seen is not None and seen.shape[:2] == (board.cols, board.rows):
        seen = seen.swapaxes(0, 1)
    if seen is not None and seen.shape[:2] == (board.rows, board.cols):
        attempts: Iterator[Array | None] = iter([seen.reshape(-1, 2)])
    else:
        attempts = _attempts(grey, (board.cols, board.rows), is_thorough)
    for found in attempts:
        if found is not None:
            return fit_crossings(grey, order_corners(grey, found, board).reshape(board.rows, board.cols, 2))
    return None


def seen_grid(grey: Grey) -> Array | None:
    """Find a checkerboard with 5x4 or more inner corners in (H, W), in about 30 ms.

    Returns:
        (rows, cols, 2) px; rows and cols may be exchanged. None if nothing is found.
    """
    width = grey.shape[1]
    scale = _SEARCH_PX / width if width > _WIDE_PX else _MOST_SCALE
    level = level_contrast(resize(grey, scale))
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    is_found, corners, meta = cv2.findChessboardCornersSBWithMeta(level, (5, 4), flags)
    return to_full_scale(corners, scale).reshape(*meta.shape[:2], 2) if is_found else None


def order_corners(grey: Grey, corners_px: Array, board: Board) -> Array:
    """Sort a grid of corners into the order of `Board.corners()`, row by row from the pattern's top left.

    A finder may start at any of the grid's ends. The camera sees the front of the pattern, so the unmirrored
    order turns from rows to columns clockwise in the image (v points down).
    For a pattern that is not symmetric under 180 deg, the outer square at the top left is black by
    convention; for a symmetric one, the order with its top row up in the image is used.

    Args:
        grey: (H, W) the image, for the colours of the squares.
        corners_px: (rows * cols, 2) row by row in any direction.
        board: the board.
    """
    grid = corners_px.reshape(board.rows, board.cols, 2)
    along_row = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    along_column = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if along_row[0] * along_column[1] - along_row[1] * along_column[0] < 0:
        grid = grid[:, ::-1]
    turns = (0, 1, 2, 3) if board.rows == board.cols else (0, 2)
    candidates = [np.rot90(grid, turn) for turn in turns]
    if not board.is_symmetric or len(turns) == 4:
        dark = [candidate for candidate in candidates if black_top_left(grey, candidate) > 0]
        candidates = dark or candidates
    best = min(candidates, key=lambda candidate: candidate[0, :, 1].mean() - candidate[-1, :, 1].mean())
    return np.ascontiguousarray(best.reshape(-1, 2))


def black_top_left(grey: Grey, grid_px: Array) -> float:
    """Compute how much darker the squares of the top left one's colour are than the others, grey values.

    Args:
        grey: (H, W).
        grid_px: (rows, cols, 2).
    """
    values = square_values(grey, grid_px)
    is_even = np.indices(values.shape).sum(axis=0) % 2 == 0
    return float(np.mean(values[~is_even]) - np.mean(values[is_even]))


def square_values(grey: Grey, grid_px: Array) -> Array:
    """Sample the grey value at the centre of each square between four corners, (rows - 1, cols - 1)."""
    centres = (grid_px[:-1, :-1] + grid_px[1:, :-1] + grid_px[:-1, 1:] + grid_px[1:, 1:]) / 4
    return sample(grey, centres)


def _attempts(grey: Grey, size: tuple[int, int], is_thorough: bool) -> Iterator[Array | None]:
    """Run the finder at several scales, cheapest first; the caller stops at the first success.

    The list does not depend on the time taken, so that the result is the same on any machine. OpenCV's older
    finder is not used: in 455 images of 17 recordings it found no board that these had missed.
    """
    width = grey.shape[1]
    if width <= _WIDE_PX:
        # A distant board in a small image, partly found by `seen_grid`.
        yield _sector_based(grey, size, 2.0, cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not is_thorough:
        return
    if width > _WIDE_PX:
        # Squares of 10 px, of a board 5 m away for example, are too small at half the size.
        yield _sector_based(grey, size, min(1.0, 1280 / width), _SB_THOROUGH)
        return
    yield _sector_based(level_contrast(grey), size, 1.5, _SB_THOROUGH)
    # Squares of 4 px in an image of full contrast, such as one reconstructed from events.
    yield _sector_based(grey, size, 2.0, _SB_THOROUGH)


def level_contrast(grey: Grey) -> Grey:
    """Equalise the mean and spread of every neighbourhood of a low-contrast image."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    mean = cv2.GaussianBlur(smooth, (0, 0), 8.0)
    spread = np.sqrt(cv2.GaussianBlur((smooth - mean) ** 2, (0, 0), 8.0)) + 4.0
    return np.asarray(np.clip(128 + 50 * (smooth - mean) / spread, 0, 255), dtype=np.uint8)


def _sector_based(grey: Grey, size: tuple[int, int], scale: float, flags: int) -> Array | None:
    """Run `cv2.findChessboardCornersSB` (A. Duda, U. Frese, BMVC 2018) at a scale of the image."""
    is_found, corners = cv2.findChessboardCornersSB(resize(grey, scale), size, flags=flags)
    return to_full_scale(corners, scale) if is_found else None


def resize(grey: Grey, scale: float) -> Grey:
    """Scale an image: cubic interpolation to enlarge it, area averaging to shrink it."""
    if scale == 1.0:
        return grey
    how = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=how), dtype=np.uint8)


def to_full_scale(corners: NDArray[Any], scale: float) -> Array:
    """Convert corners of a scaled image to (N, 2) px of the full one."""
    # Pixel centres are integers: the centre of the first pixel lies half a pixel inside the image.
    return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5


def crossing_lattice(grey: Grey, size: tuple[int, int], scale: float) -> Array | None:
    """Find a grid of exactly the given size by linking saddle points of the grey values.

    Each saddle point's two edges point at its neighbours, whose colours are inverted. Pairs that point at
    each other are linked, and the links are followed over the grid. If a corner is missing, or a false one is
    linked, the function returns None and the finders take over.

    Args:
        grey: (H, W).
        size: (cols, rows); either may be the rows.
        scale: scale of the image that is searched.

    Returns:
        (rows * cols, 2) px, row by row, to about half a pixel; None if no such grid is found.
    """
    points, edges, strengths = _saddle_points(resize(grey, scale))
    if len(points) < size[0] * size[1]:
        return None
    places = _follow_links(_link(points, edges, strengths), size[0] * size[1])
    if places is None:
        return None
    cells = np.array(list(places.values()))
    cells -= cells.min(axis=0)
    n_columns, n_rows = (int(n) for n in cells.max(axis=0) + 1)
    if {(n_columns, n_rows), (n_rows, n_columns)}.isdisjoint({size}) or len(cells) != size[0] * size[1]:
        return None
    grid = np.empty((n_rows, n_columns, 2))
    grid[cells[:, 1], cells[:, 0]] = points[list(places)]
    grid = grid if (n_columns, n_rows) == size else grid.swapaxes(0, 1)
    return to_full_scale(grid, scale)


def _saddle_points(grey: Grey) -> tuple[Array, Array, Array]:
    """Find the strongest saddle points, (N, 2) px, directions (N, 2, 2) of the two edges, and strengths (N,).

    The quadrant counter-clockwise of the first edge, in the sense from u to v, is bright.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SADDLE_SIGMA_PX)
    duu, dvv = cv2.Sobel(smooth, cv2.CV_32F, 2, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    duv = cv2.Sobel(smooth, cv2.CV_32F, 1, 1)
    response = duv * duv - duu * dvv
    is_peak = (response >= cv2.dilate(response, np.ones((3, 3), np.uint8))) & (response > 1.0)
    is_peak[:2], is_peak[-2:], is_peak[:, :2], is_peak[:, -2:] = False, False, False, False
    v, u = np.nonzero(is_peak)
    order = np.argsort(-response[v, u], kind="stable")[:_MOST_SADDLES]
    v, u = v[order], u[order]
    H = np.empty((len(u), 2, 2))
    H[:, 0, 0], H[:, 1, 1], H[:, 0, 1] = duu[v, u], dvv[v, u], duv[v, u]
    H[:, 1, 0] = H[:, 0, 1]
    values, vectors = np.linalg.eigh(H)
    # Offset from the pixel to the zero of the slope; Sobel's second derivatives are four times as large.
    slope = np.stack([smooth[v, u + 1] - smooth[v, u - 1], smooth[v + 1, u] - smooth[v - 1, u]], axis=1) / 2
    shift = np.clip(-4.0 * np.linalg.solve(H, slope[..., None])[..., 0], -1.0, 1.0)
    # Along the edges the second derivative vanishes: their angle follows from the ratio of the eigenvalues.
    half = np.arctan(np.sqrt(np.maximum(values[:, 1], 1e-9) / np.maximum(-values[:, 0], 1e-9)))
    middle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    angles = np.stack([middle - half, middle + half], axis=1)
    points = np.stack([u, v], axis=1) + shift
    return points, np.stack([np.cos(angles), np.sin(angles)], axis=-1), response[v, u]


def _link(points: Array, edges: Array, strengths: Array) -> dict[int, dict[int, tuple[int, int]]]:
    """Link mutually nearest points along their edges, by point and side: (neighbour, its side).

    Sides 0 to 3 are the first edge, the second, and both backwards.
    """
    apart = points[None] - points[:, None]
    distance = np.linalg.norm(apart, axis=-1)
    np.fill_diagonal(distance, np.inf)
    along = np.einsum("ijc,iac->aij", apart, edges) / np.maximum(distance, 1e-9)
    ratio = strengths[None] / strengths[:, None]
    is_alike = (ratio < _MOST_STRONGER) & (ratio > 1 / _MOST_STRONGER)
    nearest = np.empty((4, len(points)), dtype=np.int64)
    lengths = np.empty((4, len(points)))
    for edge in (0, 1):
        # Colours change from corner to corner, so that the first edge of one is the second of the next.
        is_back = (np.abs(along[1 - edge].T) > _ALONG) & is_alike
        for side, cosine in ((edge, along[edge]), (edge + 2, -along[edge])):
            allowed = np.where(is_back & (cosine > _ALONG), distance, np.inf)
            nearest[side], lengths[side] = allowed.argmin(axis=1), allowed.min(axis=1)
    is_near = np.isfinite(lengths) & (lengths <= _MOST_LONGER * lengths[[2, 3, 0, 1]])
    links: dict[int, dict[int, tuple[int, int]]] = {}
    for side, i in zip(*np.nonzero(is_near), strict=True):
        j = int(nearest[side, i])
        back = 1 - side % 2
        back += 2 if along[back, j, i] < 0 else 0
        if is_near[back, j] and nearest[back, j] == i:
            links.setdefault(int(i), {})[int(side)] = (j, int(back))
    return links


def _follow_links(
    links: dict[int, dict[int, tuple[int, int]]], n_wanted: int
) -> dict[int, tuple[int, int]] | None:
    """Return (column, row) of the points of a connected grid of at least n_wanted; None if links disagree.

    Corners of a grid have at least two neighbours; points with fewer are dropped as accidental.
    """
    while loose := [i for i, sides in links.items() if len(sides) < 2]:
        for i in loose:
            for j, back in links.pop(i).values():
                links.get(j, {}).pop(back, None)
    left = set(links)
    while len(left) >= n_wanted:
        first = left.pop()
        places, turns, due = {first: (0, 0)}, {first: 0}, [first]
        while due:
            i = due.pop()
            for side, (j, back) in links[i].items():
                way = (side + turns[i]) % 4
                place = (places[i][0] + _WAYS[way][0], places[i][1] + _WAYS[way][1])
                turn = (way - back - 2) % 4
                if j not in places:
                    places[j], turns[j] = place, turn
                    due.append(j)
                elif (places[j], turns[j]) != (place, turn):
                    return None
        left -= places.keys()
        if len(places) >= n_wanted:
            return places if len(set(places.values())) == len(places) else None
    return None
