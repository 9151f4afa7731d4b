"""The scene's edges in a scan and an image of one capture, with or without those at the board."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

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
from lce_rig.scene.outline_score import OutlineView, build_outline_view

_Item = TypeVar("_Item")

MAX_CAPTURES = 60
"""More captures add time and memory but, of one place, no information: they are thinned out evenly."""
_BOARD_MARGIN_RAD = 0.04  # Extrinsics may be off by as much.
_SAME_PLACE_M, _SAME_PLACE_RAD = 0.05, 0.01  # noise of ranges; azimuth steps
_MAX_COMPARED = 10  # Maximum number of captures: more of one place add no information.
_STANDING_SHARE = 0.5  # of all edges that recur before a standing rig


def build_view(
    rig: Rig, extrinsics: Calibration, name: str, image: Image | Events, scan: Scan
) -> OutlineView:
    """Find the edges of one capture's scan, and of its image or of events around the scan."""
    lidar, lens = rig.lidars[extrinsics.lidar], rig.lens_of(extrinsics)
    beam = Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad)
    return build_outline_view(name, image, scan, beam, lens, extrinsics.T_cam_lidar)


def without_board(
    view: OutlineView, found: ImageBoard | Refusal, rig: Rig, extrinsics: Calibration
) -> OutlineView:
    """Remove the edges at and near the board, if the image shows one."""
    if isinstance(found, Refusal):
        return view
    lens = rig.lens_of(extrinsics)
    outline = outline_px(found.T_cam_board, rig.board.to_board(), lens)
    hull = cv2.convexHull(outline[np.isfinite(outline).all(axis=1)].astype(np.float32))
    pixels, _ = lens.project(transform(extrinsics.T_cam_lidar, view.outlines.points))
    margin_px = _BOARD_MARGIN_RAD * lens.fx_px
    is_apart = [cv2.pointPolygonTest(hull, p, True) < -margin_px for p in pixels.tolist()]
    return replace(view, outlines=view.outlines.select(np.array(is_apart, dtype=bool)))


def without_movers(views: Sequence[OutlineView]) -> list[OutlineView]:
    """Remove the edges of objects that move in front of a standing rig, such as a person with the board.

    An edge stays if a third of the other captures, and one at least, have one in its place; it may be hidden
    in the rest. Where few edges stay, the rig itself moves, and all are kept.
    """
    from scipy.spatial import cKDTree

    compared = evenly(views, _MAX_COMPARED)
    keep = []
    for view in views:
        own, others = view.outlines, [each.outlines for each in compared if each is not view]
        tolerance_m = _SAME_PLACE_M + _SAME_PLACE_RAD * np.linalg.norm(own.points, axis=1)
        count = np.zeros(len(own))
        for other in others:
            for kind in np.unique(own.kind):
                is_kind = own.kind == kind
                tree = cKDTree(other.points[other.kind == kind])
                count[is_kind] += tree.query(own.points[is_kind])[0] < tolerance_m[is_kind]
        keep.append(count >= max(len(others) / 3, 1))
    if not keep or not (standing := np.concatenate(keep)).size or standing.mean() < _STANDING_SHARE:
        return list(views)
    return [
        replace(view, outlines=view.outlines.select(each)) for view, each in zip(views, keep, strict=True)
    ]


def evenly(items: Sequence[_Item], n: int) -> list[_Item]:
    """Choose n of the items or fewer, spread over all."""
    if len(items) <= n:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, n).round().astype(int)]
