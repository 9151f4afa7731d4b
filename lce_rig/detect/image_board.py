"""The board in a picture: corners, both poses and figures, or why there is none."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.results import ImageBoard, Refusal
from lce_rig.detect.image_corners import find_corners
from lce_rig.solvers.pnp import solve_planar_pose


def find_image_board(
    image: Image,
    board: Board,
    intrinsics: Intrinsics,
    *,
    region: tuple[int, int, int, int] | None = None,
    max_reprojection_px: float = 1.5,
) -> ImageBoard | Refusal:
    """Find the board's inner corners and its two possible poses in one picture."""
    corners = find_corners(image.grey, board)
    if corners is None:
        return Refusal("image", f"no {board.cols}x{board.rows} inner corners seen", "show the whole board")
    solved = solve_planar_pose(corners, board.corners(), intrinsics)
    if solved is None or solved.reprojection_px > max_reprojection_px:
        return Refusal("image", "the corners fit no pose of the board", "check the intrinsics")
    distance = float(np.linalg.norm(solved.T_cam_board[:3, 3]))
    return ImageBoard(
        corners_px=corners,
        T_cam_board=solved.T_cam_board,
        cov=solved.cov,
        T_cam_board_alternative=solved.T_cam_board_alternative,
        chi2_gap=solved.chi2_gap,
        is_ambiguous=solved.chi2_gap < 9.0,
        reprojection_px=solved.reprojection_px,
        sigma_px=solved.sigma_px,
        quality={"distance_m": distance},
    )
