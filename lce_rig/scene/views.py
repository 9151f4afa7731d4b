"""What a scan and an image of one capture show of the scene's edges, with or without those at the board."""

from dataclasses import replace

import cv2
import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import transform
from lce_rig.core.results import Calibration, ImageBoard, Refusal
from lce_rig.detect.events.figures import outline_px
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.rig import Rig
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.depth_edges import find_depth_edges
from lce_rig.scene.edge_field import build_edge_field

_BOARD_MARGIN_RAD = 0.04  # Extrinsics may be off by as much.
_HOLDER_M = 1.0  # The board, and the person who holds it, are so near its middle.


def build_view(rig: Rig, calibration: Calibration, name: str, image: Image, scan: Scan) -> SceneView:
    """Find the edges of one capture's scan and image."""
    lidar, lens = rig.lidars[calibration.lidar], rig.cameras[calibration.camera].to_intrinsics()
    edges = find_depth_edges(scan, Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad))
    return SceneView(name, edges, build_edge_field(image.grey, lens.fx_px))


def without_board(
    view: SceneView, found: ImageBoard | Refusal, rig: Rig, calibration: Calibration
) -> SceneView:
    """Leave out the edges at and near the board, if the image shows one."""
    if isinstance(found, Refusal):
        return view
    lens = rig.cameras[calibration.camera].to_intrinsics()
    outline = outline_px(found.T_cam_board, rig.board.to_board(), lens)
    hull = cv2.convexHull(outline[np.isfinite(outline).all(axis=1)].astype(np.float32))
    pixels, _ = lens.project(transform(calibration.T_cam_lidar, view.edges.points))
    margin_px = _BOARD_MARGIN_RAD * lens.fx_px
    is_apart = [cv2.pointPolygonTest(hull, pixel, True) < -margin_px for pixel in pixels.tolist()]
    return replace(view, edges=view.edges.select(np.array(is_apart, dtype=bool)))


def without_holder(
    view: SceneView, found: ImageBoard | Refusal | None, calibration: Calibration
) -> SceneView:
    """Leave out the edges of the board and of the person who holds it, if the image shows a board."""
    if not isinstance(found, ImageBoard):
        return view
    points_cam = transform(calibration.T_cam_lidar, view.edges.points)
    distance_m = np.linalg.norm(points_cam - found.T_cam_board[:3, 3], axis=1)
    return replace(view, edges=view.edges.select(distance_m > _HOLDER_M))
