"""Corners of ChArUco boards and AprilGrids: markers identify them, crossings locate them.

OpenCV finds markers. Those that agree with one pose of the board predict every corner. Each corner is then
measured like a checkerboard's, by the edges around it. Corners that do not look as printed count as hidden.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Figure, Refusal
from lce_rig.core.geometry import Array, transform
from lce_rig.core.pattern import DICTIONARIES, LEAST_CORNERS, Markers, markers_of
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.detect.findings import (
    IMAGE_FEW_CORNERS,
    IMAGE_OTHER_DICTIONARY,
    IMAGE_OTHER_IDS,
    IMAGE_OTHER_LAYOUT,
    IMAGE_OTHER_SPACING,
)
from lce_rig.detect.image.corners import Grey, resize, to_full_scale
from lce_rig.detect.image.saddle import REACH, Crossings, Patches, fit_crossings

Places = dict[int, Array]
"""Corners (4, 2) px of markers by their ids."""
# Images narrower than this are searched at twice their size first.
_WIDE_PX = 700
# Minimum number of markers that identify the board.
_MIN_MARKERS = 2
# Maximum distance of a marker's corners from the pose's prediction, in sides of a marker.
_MAX_AWAY = 0.25
# Minimum fraction of the board's markers that fit one pose, if their layout is the profile's.
_MIN_FITTING = 0.6
# Minimum fraction of foreign markers for a refusal: the image shows another board, or a second one.
_MIN_FOREIGN = 0.15
# Limits of a corner, relative to the others: minimum contrast, maximum misfit of the grey values.
_MIN_CONTRAST, _MAX_MISFIT = 0.5, 2.0
# Maximum distance of a corner from the pose's prediction, in units of the median.
_MAX_OFF = 7.0
# Maximum ratio of new corners to tracked ones; above, the board is searched for again.
_MOST_NEW = 0.25
# Length of the fitted part of the edges, as a fraction of the distance to the next printed element.
_FREE = 0.8
# Threshold of black below its surroundings: minimum and maximum in grey values, and in standard deviations of
# an AprilGrid's noise.
_DARKER, _MOST_DARKER, _DARKER_SIGMAS = 7.0, 25.0, 3.0
# Limits of the spacing's difference from the profile's: in tag sides (larger ones shift poses by
# centimetres), and in standard deviations (smaller ones are not significant).
_MAX_GAP_OFF, _GAP_SIGMAS = 0.01, 5.0
_GAP_SHARES = (0.05, 1.2)


def find_marked_grid(
    grey: Grey, board: Board, intrinsics: Intrinsics, *, is_thorough: bool = True
) -> Crossings | Refusal | None:
    """Find the corners of a board with markers.

    Args:
        grey: (H, W).
        board: one that has markers.
        intrinsics: intrinsics of the camera; rough ones are sufficient.
        is_thorough: whether to search at further scales, and for markers of other dictionaries.

    Returns:
        Crossings with hidden corners as NaN; None without markers; a refusal if the markers are not the
        board's.
    """
    places = _search(grey, board, is_thorough=is_thorough)
    wanted = range(board.first_id, board.first_id + len(markers_of(board).ids))
    ours = {number: corners for number, corners in places.items() if number in wanted}
    foreign = sorted(places.keys() - ours.keys())
    figures: dict[str, Figure] = {"n_markers": len(places), "dictionary": board.dictionary}
    if len(foreign) >= max(3, _MIN_FOREIGN * len(places)):
        figures |= {"first_id": wanted[0], "last_id": wanted[-1]}
        other = _other_dictionary(grey, board, len(places)) if is_thorough else None
        return other or IMAGE_OTHER_IDS.refusal(**figures, first_seen=foreign[0], last_seen=foreign[-1])
    if len(ours) < _MIN_MARKERS:
        return _other_dictionary(grey, board, len(places)) if is_thorough else None
    T_cam_board, n_fitting, is_legacy = _agree(ours, board, intrinsics)
    if T_cam_board is None or n_fitting < max(_MIN_MARKERS, _MIN_FITTING * len(ours)):
        return IMAGE_OTHER_LAYOUT.refusal(**figures, n_fitting=n_fitting)
    crossings, n_seen = _measure(grey, board, intrinsics, T_cam_board, is_legacy)
    if crossings is None:
        return IMAGE_FEW_CORNERS.refusal(**figures, n_corners=n_seen, n_needed=LEAST_CORNERS)
    gap_share = _measure_gap(crossings, board, intrinsics) if board.type == "aprilgrid" else None
    if gap_share is None:
        return crossings
    return IMAGE_OTHER_SPACING.refusal(share=round(gap_share, 3), stated=board.gap_share)


def keep_marked(
    grey: Grey, board: Board, crossings: Crossings, was_seen: NDArray[np.bool_]
) -> Crossings | None:
    """Hide the corners of a tracked board that the previous image did not show.

    Args:
        grey: (H, W).
        board: board with markers.
        crossings: crossings fitted near the corners' previous positions.
        was_seen: (rows, cols) corners visible in the previous image.

    Returns:
        The crossings with hidden corners as NaN; None if a corner is lost, or many have come into view.
    """
    signs = _signs(board)
    signs *= np.sign(np.median((signs * crossings.contrast)[was_seen]))
    is_seen = _as_printed(grey, crossings, signs)
    n_new = np.count_nonzero(is_seen & ~was_seen)
    if not is_seen[was_seen].all() or n_new > _MOST_NEW * np.count_nonzero(was_seen):
        return None
    crossings.grid_px[~was_seen] = np.nan
    crossings.is_fitted[...] = was_seen
    return crossings


def marker_corners(grey: Grey, board: Board) -> Array:
    """List the corners (N, 2) px of all markers in an image, the board's or not."""
    places = _search(grey, board, is_thorough=False)
    return np.concatenate([np.zeros((0, 2)), *places.values()])


def _search(grey: Grey, board: Board, *, is_thorough: bool) -> Places:
    """Find markers of the board's dictionary, at one scale or until half of them are found."""
    places: Places = {}
    darker = _DARKER
    if board.type == "aprilgrid":
        # Black noise pixels join tags to the squares at their corners. Markers of ChArUco boards touch
        # nothing, and their narrow white margins need the lower threshold.
        darker = min(max(_DARKER_SIGMAS * _noise(grey), _DARKER), _MOST_DARKER)
    for scale, n_border in _attempts(grey.shape[1], board):
        for number, corners in _detect(grey, board.dictionary, scale, n_border, darker).items():
            places.setdefault(number, corners)
        if not is_thorough or 2 * len(places) >= len(markers_of(board).ids):
            break
    return places


def _attempts(width_px: int, board: Board) -> Iterator[tuple[float, int]]:
    """List scales of the image and widths of the markers' borders in modules, cheapest first.

    Kalibr prints AprilGrids with a border of two modules, other programs with one.
    """
    scales = (1.0, 2.0) if width_px > _WIDE_PX else (2.0, 1.0)
    for n_border in (2, 1) if board.type == "aprilgrid" else (1,):
        yield from ((scale, n_border) for scale in scales)


def _detect(grey: Grey, dictionary: str, scale: float, n_border: int, darker: float = _DARKER) -> Places:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = n_border
    parameters.minMarkerPerimeterRate = 0.015
    # This finds seven times as many tags with modules of 2 px as OpenCV's default.
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    parameters.errorCorrectionRate = 1.0
    parameters.adaptiveThreshConstant = darker
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    corners, ids, _ = cv2.aruco.ArucoDetector(book, parameters).detectMarkers(resize(grey, scale))
    if ids is None:
        return {}
    full = [to_full_scale(four, scale) for four in corners]
    return dict(zip(ids.ravel().tolist(), full, strict=True))


def _noise(grey: Grey) -> float:
    """Estimate the standard deviation of an image's noise from its second differences along both axes."""
    across = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    rough = cv2.filter2D(grey, cv2.CV_16S, across)[1:-1:3, 1:-1:3]
    # The median magnitude of normal noise is 0.67 standard deviations; the filter multiplies these by six.
    return float(np.median(np.abs(rough))) / (0.6745 * 6)


def _other_dictionary(grey: Grey, board: Board, n_own: int) -> Refusal | None:
    """Find a dictionary with more markers in the image than the board's n_own; None without one."""
    own = _family(board.dictionary)
    best, most = "", max(n_own, 3)
    # The largest dictionary of a family includes the markers of the smaller ones.
    for name in DICTIONARIES:
        if not name.endswith(("_50", "_100", "_250")) and _family(name) != own:
            n_seen = max(len(_detect(grey, name, 1.0, n_border)) for n_border in (1, 2))
            best, most = (name, n_seen) if n_seen > most else (best, most)
    if not best:
        return None
    return IMAGE_OTHER_DICTIONARY.refusal(dictionary=board.dictionary, seen_dictionary=best, n_seen=most)


def _family(dictionary: str) -> str:
    """Return a dictionary's name without its size: "5X5" for 5X5_100; each AprilTag one is its own family."""
    return dictionary.partition("_")[0] if dictionary[0].isdigit() else dictionary


def _agree(places: Places, board: Board, intrinsics: Intrinsics) -> tuple[Array | None, int, bool]:
    """Fit one pose to markers.

    OpenCV's releases differ in the first corner of AprilTags (by 180 deg), and in the squares with markers of
    a ChArUco board with an even number of rows: the variant that fits more markers is used.

    Returns:
        The pose (4, 4); the number of markers that fit it; and whether the board is a ChArUco board of
        OpenCV's before 4.6, whose colours are exchanged.
    """
    ids = sorted(places)
    pixels = np.array([places[number] for number in ids])
    flat = _flatten(pixels, intrinsics)
    is_ahead = np.asarray(np.isfinite(flat).all(axis=(1, 2)))
    best: tuple[int, NDArray[np.bool_], Array, bool] | None = None
    for markers, turn, is_legacy in _readings(board):
        index = np.array(ids) - board.first_id
        on_board = np.roll(markers.corners[index], turn, axis=1)
        is_fitting = is_ahead & _fits(on_board[..., :2], flat, is_ahead)
        if best is None or is_fitting.sum() > best[0]:
            best = int(is_fitting.sum()), is_fitting, on_board, is_legacy
    if best is None or best[0] < _MIN_MARKERS:
        return None, 0, False
    n_fitting, is_fitting, on_board, is_legacy = best
    corners_px, corners_board = pixels[is_fitting].reshape(-1, 2), on_board[is_fitting].reshape(-1, 3)
    solved = solve_planar_pose(corners_px, corners_board, intrinsics)
    return None if solved is None else solved.T_cam_board, n_fitting, is_legacy


def _flatten(pixels: Array, intrinsics: Intrinsics) -> Array:
    """Intersect the rays of pixels (..., 2) with the plane z = 1; NaN for those far to the side."""
    rays = intrinsics.unproject(pixels.reshape(-1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = np.where(rays[:, 2:] > 0.05, rays[:, :2] / rays[:, 2:], np.nan)
    return np.asarray(flat.reshape(pixels.shape))


def _measure_gap(crossings: Crossings, board: Board, intrinsics: Intrinsics) -> float | None:
    """Estimate the tag spacing by a homography, in tag sides; None if it matches the profile.

    A wrong gap shrinks or stretches single rows and columns: neither a pose nor a lens does.
    """
    from scipy.optimize import minimize_scalar

    is_seen = np.isfinite(crossings.grid_px).all(axis=-1).ravel()
    flat = _flatten(crossings.grid_px.reshape(-1, 2)[is_seen], intrinsics)
    if not np.isfinite(flat).all():
        return None

    def misfit(share: float) -> float:
        on_board = replace(board, gap_share=share).corners()[is_seen, :2]
        H, _ = cv2.findHomography(on_board, flat)
        if H is None:
            return np.inf
        return float(np.sum((cv2.perspectiveTransform(on_board[None], H)[0] - flat) ** 2))

    found = minimize_scalar(misfit, bounds=_GAP_SHARES, method="bounded")
    # Nine unknowns: eight of a homography, and the gap.
    variance = found.fun / (2 * len(flat) - 9)
    is_other = misfit(board.gap_share) - found.fun > _GAP_SIGMAS**2 * variance
    return float(found.x) if is_other and abs(found.x - board.gap_share) > _MAX_GAP_OFF else None


def _readings(board: Board) -> Iterator[tuple[Markers, int, bool]]:
    """List readings of the markers: rotation of their corners, and whether the board is an old one."""
    yield markers_of(board), 0, False
    if board.type == "aprilgrid":
        yield markers_of(board), 2, False
    elif board.rows % 2:
        yield markers_of(board, is_legacy=True), 0, True


def _fits(on_board: Array, flat: Array, is_ahead: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the markers (M,) that agree with one homography from the board to flattened rays (M, 4, 2)."""
    away = np.full(len(flat), np.inf)
    if is_ahead.sum() >= _MIN_MARKERS:
        sides = np.linalg.norm(np.diff(flat[is_ahead], axis=1), axis=-1)
        limit = _MAX_AWAY * float(np.median(sides))
        H, _ = cv2.findHomography(
            on_board[is_ahead].reshape(-1, 2), flat[is_ahead].reshape(-1, 2), cv2.RANSAC, limit
        )
        if H is not None:
            drawn = cv2.perspectiveTransform(on_board.reshape(1, -1, 2), H).reshape(flat.shape)
            away = np.linalg.norm(drawn - flat, axis=-1).max(axis=1) / limit
    return np.asarray(away < 1)


def _measure(
    grey: Grey, board: Board, intrinsics: Intrinsics, T_cam_board: Array, is_legacy: bool
) -> tuple[Crossings | None, int]:
    """Locate the corners near a pose's prediction, and count them; None if too few are visible."""
    shape, corners = (board.rows, board.cols), board.corners()
    signs = _signs(board) * (-1 if is_legacy else 1)
    grid_px = intrinsics.project(transform(T_cam_board, corners))[0].reshape(*shape, 2)
    for _ in range(2):
        if not np.isfinite(grid_px).all():
            return None, 0
        crossings = fit_crossings(grey, grid_px, patches=marked_patches(board, intrinsics, T_cam_board))
        is_seen = _as_printed(grey, crossings, signs)
        # The better half is hardly covered, so it alone determines the first pose.
        usual = np.median(crossings.misfit[is_seen]) if is_seen.any() else 0.0
        is_trusted = is_seen & (crossings.misfit <= usual)
        for _ in range(3):
            n_seen = int(is_seen.sum())
            if n_seen < LEAST_CORNERS or min(is_seen.any(axis=0).sum(), is_seen.any(axis=1).sum()) < 2:
                return None, n_seen
            is_used = is_trusted if is_trusted.sum() >= LEAST_CORNERS else is_seen
            used_px = np.where(is_used[..., None], crossings.grid_px, np.nan).reshape(-1, 2)
            solved = solve_planar_pose(used_px, corners, intrinsics)
            if solved is None:
                return None, n_seen
            predicted = intrinsics.project(transform(solved.T_cam_board, corners))[0].reshape(*shape, 2)
            away = np.linalg.norm(predicted - crossings.grid_px, axis=-1)
            is_seen &= away <= max(_MAX_OFF * float(np.median(away[is_used])), 0.1)
            is_trusted, T_cam_board = is_seen, solved.T_cam_board
        # Patches centred on their corners contain no neighbouring marks.
        grid_px = np.where(is_seen[..., None], crossings.grid_px, predicted)
    crossings.grid_px[~is_seen] = np.nan
    crossings.is_fitted[...] = is_seen
    return crossings, int(is_seen.sum())


def _signs(board: Board) -> Array:
    """List the signs of the corners' contrasts (rows, cols), inverted for old ChArUco boards.

    The corner at the upper left of a black square or tag is dark there and at its lower right.
    """
    return np.asarray(-((-1.0) ** np.indices((board.rows, board.cols)).sum(axis=0)))


def _as_printed(grey: Grey, crossings: Crossings, signs: Array) -> NDArray[np.bool_]:
    """Find the corners (rows, cols) whose surroundings match the others' and the printed colours."""
    height, width = grey.shape
    contrast = signs * crossings.contrast
    is_good = crossings.is_fitted & (contrast > 0)
    is_good &= np.all((crossings.grid_px >= 1) & (crossings.grid_px <= [width - 2, height - 2]), axis=-1)
    if not is_good.any():
        return is_good
    usual = float(np.percentile(contrast[is_good], 75))
    is_good &= contrast > _MIN_CONTRAST * usual
    return is_good & (crossings.misfit <= _MAX_MISFIT * float(np.median(crossings.misfit[is_good])) + 0.5)


def marked_patches(board: Board, intrinsics: Intrinsics, T_cam_board: Array) -> Patches:
    """Describe the patches around the corners in an image, limited by the markers."""
    if board.type == "charuco":
        unit_m, clear_m = board.square_m, _FREE * (1 - board.marker_share) / 2 * board.square_m
    else:
        # The next corner is a gap away; a border of one module of eight is the narrowest.
        unit_m, clear_m = _FREE * board.gap_share * board.square_m / REACH, _FREE * board.square_m / 8
    corners, shape = board.corners(), (board.rows, board.cols, 2)
    right, down = (
        np.asarray(
            intrinsics.project(transform(T_cam_board, corners + half))[0]
            - intrinsics.project(transform(T_cam_board, corners - half))[0]
        ).reshape(shape)
        for half in np.array([[unit_m / 2, 0, 0], [0, -unit_m / 2, 0]])
    )
    return Patches(right, down, clear_m / unit_m)
