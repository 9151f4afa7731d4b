"""The board in an image: corners, both poses and figures, or the reason why it is missing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.camera import CUT_FRACTION, Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.errors import ProfileError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, transform
from lce_rig.core.planar_pose import PlanarPose, solve_planar_pose
from lce_rig.core.results import ImageBoard, ImageQuality
from lce_rig.detect.findings import (
    IMAGE_MISFIT,
    IMAGE_NO_POSE,
    IMAGE_NOT_AT_FIRST_SIGHT,
)
from lce_rig.detect.image.corners import find_grid, order_corners, seen_grid
from lce_rig.detect.image.markers import find_marked_grid, keep_marked, marked_patches
from lce_rig.detect.image.quality import (
    explain_absence,
    explain_other_grid,
    grid_quality,
    is_whole,
    quality_problem,
)
from lce_rig.detect.image.saddle import Crossings, fit_crossings
from lce_rig.rig import QualitySettings

STANDARD = QualitySettings()
NOT_SEEN_AT_ONCE = IMAGE_NOT_AT_FIRST_SIGHT.refusal()
"""Hint of a search that was not thorough."""

# Maximum excess of an image over the sensor, relative to the sensor's size; a larger canvas costs memory.
_CANVAS_FRACTION = 3.0
# Maximum fraction of corners that the finder misplaced or an artefact covers.
_MAX_MISPLACED = 0.08
# Samples per side for tracked boards: a quarter of a full fit's time; corners have 0.03 px, sufficient for
# stillness and guidance.
_FOLLOWED_SAMPLES = 13
# Maximum movement of a still board's corners, px.
_RESTING_PX = 0.5
# Minimum measurable fraction of a grid's corners.
_MIN_FITTED = 0.5


def find_image_board(
    image: Image,
    board: Board,
    intrinsics: Intrinsics,
    *,
    last: ImageBoard | None = None,
    limits: QualitySettings = STANDARD,
    is_from_events: bool = False,
    is_thorough: bool = True,
) -> ImageBoard | Refusal:
    """Find the board's inner corners in one image and T_cam_board in both its minima.

    Corners are in the order of `Board.corners()`. A pattern that is not symmetric under 180 deg has a black
    outer square at its top left; a symmetric one is read with its top row up in the image. For boards with
    markers, which identify the corners, a part is sufficient.

    Args:
        image: the image.
        board: the board as the profile describes it.
        intrinsics: intrinsics of the camera, at the image's resolution.
        last: the board in the previous image: if it is within a third of a square of its place there, the
            search is skipped; else its surroundings are searched first.
        limits: `quality` of the rig profile.
        is_from_events: whether the image was reconstructed from events, by us or by others.
        is_thorough: whether to search at further scales for a board that is not found at once, and to explain
            its absence, which takes most of a second.

    Raises:
        ProfileError: the intrinsics belong to images of another size.
    """
    grey = crop_to_intrinsics(image, intrinsics)
    followed = None if is_from_events or last is None else _follow(grey, board, intrinsics, last)
    if board.has_markers:
        marked = followed or find_marked_grid(grey, board, intrinsics, is_thorough=is_thorough)
        if isinstance(marked, Refusal):
            return marked
        crossings = marked
    else:
        crossings = (
            followed
            or _find_near(grey, board, last, is_thorough=is_thorough)
            or find_grid(grey, board, is_thorough=is_thorough)
        )
    if crossings is None and not is_thorough:
        return NOT_SEEN_AT_ONCE
    if crossings is None or not (board.has_markers or np.mean(crossings.is_fitted) >= _MIN_FITTED):
        return explain_absence(grey, board, is_from_events)
    quality = grid_quality(grey, crossings)
    if not board.has_markers and not is_whole(grey, crossings.grid_px):
        seen = seen_grid(grey)
        seen = crossings.grid_px if seen is None else seen
        return explain_other_grid(grey, board, seen, is_from_events)
    problem = quality_problem(quality, limits, is_from_events)
    if problem is not None:
        return problem

    # The poses of a tracked board are near its last ones.
    poses = [] if followed is None or last is None else [last.T_cam_board, last.T_cam_board_alternative]
    near = [T_cam_board for T_cam_board in poses if T_cam_board is not None]
    if board.has_markers:
        solved = solve_planar_pose(crossings.grid_px.reshape(-1, 2), board.corners(), intrinsics, near)
    else:
        solved, crossings = _solve(grey, crossings, board, intrinsics, near)
    lens = {"model": intrinsics.model, "width_px": intrinsics.width_px, "height_px": intrinsics.height_px}
    if solved is None:
        return IMAGE_NO_POSE.refusal(**lens)
    if solved.reprojection_px > limits.max_reprojection_px:
        errors = {"rms_px": solved.reprojection_px, "max_rms_px": limits.max_reprojection_px}
        return IMAGE_MISFIT.refusal(**lens, **errors)
    quality = replace(quality, n_corners=int(crossings.is_fitted.sum()))
    return board_from_pose(crossings.grid_px.reshape(-1, 2), solved, quality)


def board_from_pose(corners_px: Array, solved: PlanarPose, quality: ImageQuality | None = None) -> ImageBoard:
    """Assemble the detection in an image once its pose is solved.

    Args:
        corners_px: (rows * cols, 2) in the order of `Board.corners()`, NaN where hidden.
        solved: both poses that fit the corners.
        quality: figures of the image.
    """
    return ImageBoard(**solved._asdict(), corners_px=corners_px, quality=quality)


def crop_to_intrinsics(image: Image, intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """Crop the grey image to the size of the intrinsics, if it is larger.

    Two harmless differences occur in recordings: a readout that ends a few lines early, and images
    reconstructed from events with a blank margin beyond the sensor's size.

    Raises:
        ProfileError: the sizes do not match; the message states both.
    """
    height, width = image.pixels.shape[:2]
    wanted_width, wanted_height = intrinsics.width_px, intrinsics.height_px
    grey = image.grey[:wanted_height, :wanted_width]
    missing_u, missing_v = 1 - width / wanted_width, 1 - height / wanted_height
    if 0 <= missing_u <= CUT_FRACTION and 0 <= missing_v <= CUT_FRACTION:
        return grey
    if -_CANVAS_FRACTION <= missing_u <= 0 and -_CANVAS_FRACTION <= missing_v <= 0:
        # Right of and below the sensor's size there is only a smooth background; the columns next to the
        # sensor's are not judged.
        steps = np.abs(np.diff(image.grey.astype(np.int16), axis=1))
        inside = np.percentile(steps[:wanted_height, : wanted_width - 1], 99)
        beyond = (steps[wanted_height:].ravel(), steps[:wanted_height, wanted_width + 8 :].ravel())
        outside = np.concatenate(beyond)
        if len(outside) and np.percentile(outside, 99) <= max(0.3 * inside, 2.0):
            return grey
    hint = "Use the intrinsics of this mode, or record in the mode of the intrinsics."
    if abs(width / wanted_width - height / wanted_height) < 0.01 * width / wanted_width:
        hint = f"Multiply fx, fy, cx, cy by {width / wanted_width:.4g} if the image is only scaled."
    elif (width, height) == (wanted_height, wanted_width):
        hint = f"Set resolution_px: [{width}, {height}], and check fx, fy, cx, cy."
    raise ProfileError(
        f"{image.sensor}.{image.channel}: {width}x{height} px cannot be used, "
        f"the profile's intrinsics belong to {wanted_width}x{wanted_height} px",
        hint,
    )


def _follow(
    grey: NDArray[np.uint8], board: Board, intrinsics: Intrinsics, last: ImageBoard
) -> Crossings | None:
    """Fit the corners from their positions in the previous image; None unless the board is complete.

    A board that moved by a whole square is rejected, as squares are missing on one side.
    """
    start_px, patches = last.corners_px.reshape(board.rows, board.cols, 2), None
    was_seen = np.asarray(np.isfinite(start_px).all(axis=-1))
    if board.has_markers:
        patches = marked_patches(board, intrinsics, last.T_cam_board)
        drawn_px, _ = intrinsics.project(transform(last.T_cam_board, board.corners()))
        start_px = np.where(was_seen[..., None], start_px, drawn_px.reshape(start_px.shape))
    crossings = fit_crossings(grey, start_px, _FOLLOWED_SAMPLES, patches)
    if np.abs(crossings.grid_px - start_px)[was_seen].max() > _RESTING_PX:
        # Patches beside their corners bias the fit.
        crossings = fit_crossings(grey, crossings.grid_px, _FOLLOWED_SAMPLES, patches)
    if not crossings.is_fitted[was_seen].all():
        return None
    if board.has_markers:
        return keep_marked(grey, board, crossings, was_seen)
    fitted_px = crossings.grid_px.reshape(-1, 2)
    is_in_order = np.array_equal(order_corners(grey, fitted_px, board), fitted_px)
    return crossings if is_in_order and is_whole(grey, crossings.grid_px) else None


def _find_near(
    grey: NDArray[np.uint8], board: Board, last: ImageBoard | None, *, is_thorough: bool
) -> Crossings | None:
    """Search near the board's last position."""
    if last is None:
        return None
    # Bounding box of the corners, enlarged by half its size.
    low, high = np.nanmin(last.corners_px, axis=0), np.nanmax(last.corners_px, axis=0)
    reach = 0.5 * (high - low).max() + 8
    u0, v0 = np.maximum(np.floor(low - reach), 0).astype(int)
    u1, v1 = np.ceil(high + reach).astype(int) + 1
    part = grey[v0:v1, u0:u1]
    if min(part.shape) < 16:
        return None
    crossings = find_grid(np.ascontiguousarray(part), board, is_thorough=is_thorough)
    return None if crossings is None else replace(crossings, grid_px=crossings.grid_px + [u0, v0])


def _solve(
    grey: NDArray[np.uint8],
    crossings: Crossings,
    board: Board,
    intrinsics: Intrinsics,
    near: Sequence[Array] = (),
) -> tuple[PlanarPose | None, Crossings]:
    """Solve for the pose; search corners far from their predicted positions again.

    Finders occasionally place single corners on an artefact. If they are few, they are fitted again from the
    positions predicted by the others. A corner whose fit fails there keeps the predicted position and is not
    counted in `n_corners`.
    """
    corners_board = board.corners()
    solved = solve_planar_pose(crossings.grid_px.reshape(-1, 2), corners_board, intrinsics, near)
    if solved is None:
        return None, crossings
    error_px = _errors(solved.T_cam_board, crossings, corners_board, intrinsics)
    is_far = error_px > max(6.0 * float(np.median(error_px)), 0.5)
    is_far |= ~crossings.is_fitted.ravel()
    if not is_far.any() or is_far.mean() > _MAX_MISPLACED:
        return solved, crossings

    good = ~is_far
    rest = solve_planar_pose(crossings.grid_px.reshape(-1, 2)[good], corners_board[good], intrinsics)
    if rest is None:
        return solved, crossings
    predicted, _ = intrinsics.project(transform(rest.T_cam_board, corners_board))
    starts = np.where(is_far[:, None], predicted, crossings.grid_px.reshape(-1, 2))
    again = fit_crossings(grey, starts.reshape(crossings.grid_px.shape))
    still_far = _errors(rest.T_cam_board, again, corners_board, intrinsics) > 6.0 * rest.reprojection_px
    is_lost = (is_far & (still_far | ~again.is_fitted.ravel())).reshape(again.is_fitted.shape)
    repaired = Crossings(
        grid_px=np.where(is_lost[..., None], predicted.reshape(again.grid_px.shape), again.grid_px),
        is_fitted=~is_lost,
        contrast=again.contrast,
        edge_sigma_px=again.edge_sigma_px,
        misfit=again.misfit,
    )
    return solve_planar_pose(repaired.grid_px.reshape(-1, 2), corners_board, intrinsics), repaired


def _errors(T_cam_board: Array, crossings: Crossings, corners_board: Array, intrinsics: Intrinsics) -> Array:
    predicted, _ = intrinsics.project(transform(T_cam_board, corners_board))
    return np.asarray(np.linalg.norm(predicted - crossings.grid_px.reshape(-1, 2), axis=1))
