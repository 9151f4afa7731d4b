"""What a scan and an image of one capture show of the scene's edges, with or without those at the board."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import transform
from lce_rig.core.results import ImageBoard
from lce_rig.detect.events.figures import outline_px
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.rig import Rig
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.depth_edges import find_depth_edges, leave_standing
from lce_rig.scene.edge_field import build_edge_field, build_event_field

MAX_CAPTURES = 60
"""More captures add time and memory but, of one place, no information: they are thinned out evenly."""
_BOARD_MARGIN_RAD = 0.04  # Extrinsics may be off by as much.
_EVENTS_NEAR_RAD = 0.06  # as far as the score is searched


def build_view(rig: Rig, extrinsics: Calibration, name: str, image: Image | Events, scan: Scan) -> SceneView:
    """Find the edges of one capture's scan, and of its image or of events about the scan."""
    lidar, lens = rig.lidars[extrinsics.lidar], rig.lens_of(extrinsics)
    edges = find_depth_edges(scan, Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad))
    if isinstance(image, Image):
        return SceneView(name, edges, build_edge_field(image.grey, lens.fx_px))
    field = build_event_field(image, lens.fx_px)
    # Edges without events about them stand still before a standing rig: they say nothing.
    pixels, _ = lens.project(transform(extrinsics.T_cam_lidar, edges.points))
    return SceneView(name, edges.select(field.has_edges_near(pixels, _EVENTS_NEAR_RAD * lens.fx_px)), field)


def without_board(
    view: SceneView, found: ImageBoard | Refusal, rig: Rig, extrinsics: Calibration
) -> SceneView:
    """Leave out the edges at and near the board, if the image shows one."""
    if isinstance(found, Refusal):
        return view
    lens = rig.lens_of(extrinsics)
    outline = outline_px(found.T_cam_board, rig.board.to_board(), lens)
    hull = cv2.convexHull(outline[np.isfinite(outline).all(axis=1)].astype(np.float32))
    pixels, _ = lens.project(transform(extrinsics.T_cam_lidar, view.edges.points))
    margin_px = _BOARD_MARGIN_RAD * lens.fx_px
    is_apart = [cv2.pointPolygonTest(hull, p, True) < -margin_px for p in pixels.tolist()]
    return replace(view, edges=view.edges.select(np.array(is_apart, dtype=bool)))


def without_movers(views: Sequence[SceneView]) -> list[SceneView]:
    """Leave out the edges of what moves before a standing rig, such as who holds the board."""
    standing = leave_standing([view.edges for view in views])
    return [replace(view, edges=edges) for view, edges in zip(views, standing, strict=True)]
