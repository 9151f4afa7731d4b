"""How well extrinsics bring a scene's depth edges onto its image edges, by part of the scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, perturb, transform
from lce_rig.scene.depth_edges import CHANNELS, DepthEdges
from lce_rig.scene.edge_field import EdgeField

IS_ROTATION = np.array([False, False, False, True, True, True])

_COLUMNS, _ROWS = 8, 3  # parts of the image
_BESIDE_RAD = 0.05
"""Edges so far outside the image count: other extrinsics bring them in."""
_REACH = np.where(IS_ROTATION, np.radians(3.0), 0.3)
_STEPS = np.linspace(-1.0, 1.0, 61)


@dataclass(frozen=True, eq=False)
class SceneView:
    """One capture: what the LiDAR and the camera saw of the scene's edges."""

    capture: str
    edges: DepthEdges
    field: EdgeField


class Alignment:
    """The score of extrinsics on several captures: the sum of the fields at the projected depth edges.

    Captures of a standing rig show the same edges, so a part of the image is one witness over all captures.

    Args:
        views: at least one.
        intrinsics: of the camera.
        T_cam_lidar: (4, 4) that perturbations start from.
    """

    def __init__(self, views: Sequence[SceneView], intrinsics: Intrinsics, T_cam_lidar: Array) -> None:
        self._intrinsics, self.T_cam_lidar = intrinsics, T_cam_lidar
        points = np.concatenate([view.edges.points for view in views])
        pixels, _ = intrinsics.project(transform(T_cam_lidar, points))
        margin_px = -_BESIDE_RAD * intrinsics.fx_px
        near = intrinsics.is_inside(pixels, margin_px)
        of_view = np.repeat(np.arange(len(views)), [len(view.edges) for view in views])
        self._points, self.n_captures = points[near], len(views)
        self._weight = np.concatenate([view.edges.weight for view in views])[near]
        self._fields = [view.field for view in views]
        self._of_view = of_view[near]
        self._slices = [
            slice(*np.searchsorted(self._of_view, (k, k + 1)).tolist()) for k in range(len(views))
        ]
        column = np.clip(pixels[near, 0] / intrinsics.width_px * _COLUMNS, 0, _COLUMNS - 1).astype(np.intp)
        row = np.clip(pixels[near, 1] / intrinsics.height_px * _ROWS, 0, _ROWS - 1).astype(np.intp)
        # Each channel has its own parts: it is a witness of its own.
        channel = np.concatenate([view.edges.channel for view in views])[near].astype(np.intp)
        self._part = (channel * _COLUMNS + column) * _ROWS + row

    def __len__(self) -> int:
        """Count the depth edges in or near the images."""
        return len(self._points)

    @property
    def weight_of_parts(self) -> Array:
        """Sum of weights of the parts of the image (columns, rows)."""
        by_part = self._by_part(self._weight).reshape(len(CHANNELS), _COLUMNS, _ROWS)
        return np.asarray(by_part.sum(axis=0))

    def _by_part(self, values: Array) -> Array:
        return np.asarray(np.bincount(self._part, values, len(CHANNELS) * _COLUMNS * _ROWS), dtype=np.float64)

    def _sample(self, pixels: Array) -> Array:
        values = np.empty(pixels.shape[:-1])
        for field, chosen in zip(self._fields, self._slices, strict=True):
            values[..., chosen] = field.sample(pixels[..., chosen, :])
        return values

    def shares(self, T_cam_lidar: Array) -> Array:
        """Score extrinsics (..., 4, 4): each edge's share (..., N), divided by the number of captures."""
        pixels, _ = self._intrinsics.project(transform(T_cam_lidar, self._points))
        return self._weight / self.n_captures * self._sample(pixels)

    def curve(self, axis: int, start: Array) -> "Curve":
        """Score extrinsics along one axis of the tangent, the others as in `start` (6,)."""
        offsets = _STEPS * _REACH[axis]
        shares = self.shares(perturb(self.T_cam_lidar, start + offsets[:, None] * np.eye(6)[axis]))
        by_part, by_capture = zip(*map(self.split, shares), strict=True)
        return Curve(offsets, np.array(by_part), np.array(by_capture))

    def split(self, shares: Array) -> tuple[Array, Array]:
        """Sum shares (N,) over each channel's parts of the image, (P,), and over the captures, (C,)."""
        by_capture = np.bincount(self._of_view, shares, self.n_captures)
        return self._by_part(shares), np.asarray(by_capture, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Curve:
    """The score along one axis.

    Attributes:
        offsets: (K,) m or rad.
        by_part: (K, P) score of each part of the image.
        by_capture: (K, C) of each capture.
    """

    offsets: Array
    by_part: Array
    by_capture: Array

    @property
    def total(self) -> Array:
        """The score, (K,)."""
        return np.asarray(self.by_part.sum(axis=1))

    @property
    def peak(self) -> float:
        """Where the score is highest."""
        return float(_peaks(self.total[:, None], self.offsets)[0])

    def sigma(self) -> float:
        """Standard deviation of the peak: the larger of the jackknives over parts and over captures."""
        return max(self._jackknife(self.by_part), self._jackknife(self.by_capture))

    def _jackknife(self, shares: Array) -> float:
        shares = shares[:, np.any(shares != 0, axis=0)]
        n = shares.shape[1]
        if n < 2:
            return 0.0
        peaks = _peaks(shares.sum(axis=1, keepdims=True) - shares, self.offsets)
        return float(np.sqrt((n - 1) / n * np.sum((peaks - peaks.mean()) ** 2)))

    def at(self, offset: float) -> Array:
        """Interpolate the parts' scores at an offset, (P,)."""
        return np.array([np.interp(offset, self.offsets, part) for part in self.by_part.T])

    def significance(self, offset: float, other: float | None = None) -> float:
        """How surely the score at an offset exceeds that at another: the sum over parts by its scatter.

        Args:
            offset: the one that should be better.
            other: the one compared with; None for the mean of those a third of the range away and more.
        """
        if other is None:
            away = np.abs(self.offsets - offset) > 2 / 3 * self.offsets[-1]
            reference = self.by_part[away].mean(axis=0)
        else:
            reference = self.at(other)
        gains = self.at(offset) - reference
        return float(gains.sum() / max(np.sqrt(np.sum(gains**2)), 1e-12))

    def smallest_significant(self, limit: float) -> float:
        """Find how far from the peak, on either side, its significance exceeds a limit; inf if never."""
        gains = self.at(self.peak) - self.by_part
        significance = gains.sum(axis=1) / np.maximum(np.sqrt(np.sum(gains**2, axis=1)), 1e-12)
        off = self.offsets - self.peak
        beyond = [np.abs(off[(significance > limit) & (off * side > 0)]) for side in (-1, 1)]
        return max(float(each.min(initial=np.inf)) for each in beyond)


def _peaks(columns: Array, offsets: Array) -> Array:
    """Find the highest point of each column (K, N), between grid points by a parabola."""
    index = np.clip(columns.argmax(axis=0), 1, len(offsets) - 2)
    pick = np.arange(columns.shape[1])
    before, at, after = (columns[index + shift, pick] for shift in (-1, 0, 1))
    bend = before - 2 * at + after
    step = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return np.asarray(offsets[index] + np.clip(step, -1, 1) * (offsets[1] - offsets[0]))
