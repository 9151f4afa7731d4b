"""Score of extrinsics: the fields of image edges at the projected outlines, with derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import Array, perturb, skew, transform
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.scene.edge_pyramid import (
    SIGMAS_RAD,
    EdgePyramid,
    build_edge_pyramid,
    build_event_pyramid,
    places,
)
from lce_rig.scene.outlines import KINDS_OF_EDGES, LEVEL, Outlines, find_outlines

_BESIDE_RAD = 0.06  # As far as the score is searched: outlines so near the image, or events, are used.
_NEAREST_M = 0.5  # in front of the camera
_MAX_EDGES = 4000  # of one view; more add time and, of one view, hardly any information
_COLUMNS, _ROWS = 8, 3  # Blocks of the image


@dataclass(frozen=True, eq=False)
class OutlineView:
    """Edges of one scan and of one image of the same scene.

    Attributes:
        capture: the capture's name.
        outlines: outlines of the scan, near the image.
        pyramid: fields of the image's edges.
    """

    capture: str
    outlines: Outlines
    pyramid: EdgePyramid


def build_outline_view(
    capture: str, image: Image | Events, scan: Scan, beam: Beam, intrinsics: Intrinsics, T_cam_lidar: Array
) -> OutlineView:
    """Find the edges of a scan near the image, and those of the image.

    Args:
        capture: name of the view.
        image: image of the camera, or its events about the scan.
        scan: scan of the LiDAR.
        beam: beam of the LiDAR.
        intrinsics: intrinsics of the camera.
        T_cam_lidar: (4, 4) rough extrinsics, within a few degrees.
    """
    at_camera = transform(T_cam_lidar, scan.points)
    pixels, _ = intrinsics.project(at_camera)
    near = (at_camera[:, 2] > _NEAREST_M) & intrinsics.is_inside(pixels, -_BESIDE_RAD * intrinsics.fx_px)
    outlines = find_outlines(scan.points[near], scan.intensity[near], beam)
    if len(outlines) > _MAX_EDGES:
        outlines = outlines.select(np.linspace(0, len(outlines) - 1, _MAX_EDGES).round().astype(np.intp))
    if isinstance(image, Image):
        return OutlineView(capture, outlines, build_edge_pyramid(image.grey, intrinsics.fx_px))
    pyramid = build_event_pyramid(image, intrinsics.fx_px)
    # Edges without events about them stand still before a standing rig: they say nothing.
    pixels, _ = intrinsics.project(transform(T_cam_lidar, outlines.points))
    has_events = pyramid.has_edges_near(pixels, _BESIDE_RAD * intrinsics.fx_px)
    return OutlineView(capture, outlines.select(has_events), pyramid)


class OutlineScore:
    """Mean log-likelihood ratio of the outlines of all views under extrinsics, at one width of the fields.

    Args:
        views: at least one with an outline.
        intrinsics: intrinsics of the camera.
        T_cam_lidar: (4, 4) that tangents start from.
        level: index of SIGMAS_RAD.
    """

    def __init__(
        self, views: Sequence[OutlineView], intrinsics: Intrinsics, T_cam_lidar: Array, level: int
    ) -> None:
        self._intrinsics, self.T_cam_lidar = intrinsics, T_cam_lidar
        order = [np.argsort(view.outlines.kind == LEVEL, kind="stable") for view in views]
        outlines = [view.outlines.select(each) for view, each in zip(views, order, strict=True)]
        # Store each coordinate contiguously: numpy processes them faster.
        self._points = np.concatenate([each.points for each in outlines]).T.copy().T
        weight = np.concatenate([each.weight for each in outlines])
        self._weight = weight / max(weight.sum(), 1e-12)
        self._kind = np.concatenate([each.kind for each in outlines])
        self._view = np.repeat(np.arange(len(views)), [len(each) for each in outlines])
        # Vertical outlines and reflectivities of a view first, then its horizontal outlines.
        counts = [(int(np.sum(each.kind != LEVEL)), int(np.sum(each.kind == LEVEL))) for each in outlines]
        ends = np.cumsum([0, *(count for pair in counts for count in pair)]).tolist()
        self._layers = [
            (layer, slice(ends[2 * k + axis], ends[2 * k + axis + 1]))
            for k, view in enumerate(views)
            for axis, layer in enumerate(view.pyramid.levels[level])
        ]
        counts_of_layers = [chosen.stop - chosen.start for _, chosen in self._layers]
        self._reduction = np.repeat([layer.reduction for layer, _ in self._layers], counts_of_layers)

    @classmethod
    def finest(
        cls, views: Sequence[OutlineView], intrinsics: Intrinsics, T_cam_lidar: Array
    ) -> "OutlineScore":
        """Score the views that have outlines on the finest fields; at least one has."""
        seen = [view for view in views if len(view.outlines)]
        return cls(seen, intrinsics, T_cam_lidar, len(SIGMAS_RAD) - 1)

    def __len__(self) -> int:
        return len(self._points)

    def edges(self, tangent: Array) -> tuple[Array, Array, Array]:
        """Score each edge under extrinsics moved by a tangent (6,).

        Returns:
            Shares (N,) of the score; their derivatives (N, 6) by a further tangent; pixels (N, 2).
        """
        T = perturb(self.T_cam_lidar, tangent)
        at_camera = self._at_camera(T)
        pixels, is_valid = self._intrinsics.project(at_camera)
        sampled = self._sample(pixels) * self._weight[:, None]
        by_point = np.einsum("ni,nij->nj", sampled[:, 1:], self._slopes(at_camera, is_valid))
        x, y, z = (at_camera - T[:3, 3]).T
        u, v, w = by_point.T
        slopes = np.stack([u, v, w, y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
        return sampled[:, 0], slopes, pixels

    def _at_camera(self, T_cam_lidar: Array) -> Array:
        """Transform all points as `transform` does, keeping their layout in memory."""
        return np.asarray((T_cam_lidar[:3, :3] @ self._points.T + T_cam_lidar[:3, 3:]).T)

    def _sample(self, pixels: Array) -> Array:
        """Interpolate the fields and their derivatives (N, 3) at pixels (N, 2); 0 outside and where NaN."""
        at = places(pixels, self._reduction)
        return np.concatenate([layer.interpolate(at[:, chosen]) for layer, chosen in self._layers])

    def _slopes(self, at_camera: Array, is_valid: NDArray[np.bool_]) -> Array:
        if not is_valid.all():
            at_camera = np.where(is_valid[:, None], at_camera, [0.0, 0.0, 1.0])
        return self._intrinsics.differentiate(at_camera)

    def value(self, tangent: Array) -> float:
        """Score extrinsics moved by a tangent (6,)."""
        pixels, _ = self._intrinsics.project(self._at_camera(perturb(self.T_cam_lidar, tangent)))
        return float(self._weight @ self._sample(pixels)[:, 0])

    def score(self, tangent: Array) -> tuple[float, Array]:
        """Score extrinsics moved by a tangent (6,), with the derivative (6,) by that tangent."""
        shares, slopes, _ = self.edges(tangent)
        slope = slopes.sum(axis=0)
        # exp((phi + dphi)^) = exp((J dphi)^) exp(phi^), J = I + phi^ / 2 up to terms of second order.
        left = np.eye(3) + skew(tangent[3:]) / 2
        return float(shares.sum()), np.concatenate([slope[:3], left.T @ slope[3:]])

    def of_matching_views(self, tangent: Array) -> float:
        """Score extrinsics by the views that match better than by chance; the others have no weight."""
        shares, _, _ = self.edges(tangent)
        total, weight = (np.bincount(self._view, each) for each in (shares, self._weight))
        matches = total > 0
        return float(total[matches].sum() / weight[matches].sum()) if matches.any() else 0.0

    def blocks(self, pixels: Array) -> NDArray[np.intp]:
        """Return the block (N,) of each edge: its kind and its part of the image, the same in all views.

        Views of one room show the same edges, so they are no blocks of their own.
        """
        width_px, height_px = self._intrinsics.width_px, self._intrinsics.height_px
        at = np.nan_to_num(pixels / [width_px, height_px] * [_COLUMNS, _ROWS])
        column, row = np.clip(at, 0, [_COLUMNS - 1, _ROWS - 1]).astype(np.intp).T
        return np.asarray((self._kind * _COLUMNS + column) * _ROWS + row, dtype=np.intp)


N_BLOCKS = len(KINDS_OF_EDGES) * _COLUMNS * _ROWS
