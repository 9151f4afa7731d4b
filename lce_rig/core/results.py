"""Boards detected in images and scans, and the observations made from them."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import NO_RING
from lce_rig.core.geometry import Array, fit_plane, shortened


@dataclass(frozen=True)
class ImageQuality:
    """Figures of the pattern in an image.

    Attributes:
        contrast: white minus black squares, grey values.
        square_px: shortest side of a square; 0 if no two neighbours are visible.
        edge_width_px: width of the squares' edges, 10-90 %.
        sharpness: edge widths in a square: 1 is unreadable, above 5 is crisp.
        border_px: distance of the outermost corner from the border of the image.
        n_corners: number of fitted corners.
    """

    contrast: float
    square_px: float
    edge_width_px: float
    sharpness: float
    border_px: float
    n_corners: int


@dataclass(frozen=True)
class EventQuality:
    """Figures of the board and its motion from events; NaN if not measured.

    Attributes:
        events_px_s: events per second and pixel of the board, just before the image.
        events_px: events per pixel of the board in the time that the network remembers.
        speed_mps, turn_deg_s: speed and rotation rate of the board around the time of the image.
        speed_sigma_mps, turn_sigma_deg_s: standard deviation of these.
        smear_m: motion of the board while the LiDAR scans it.
    """

    events_px_s: float
    events_px: float
    speed_mps: float = math.nan
    speed_sigma_mps: float = math.nan
    turn_deg_s: float = math.nan
    turn_sigma_deg_s: float = math.nan
    smear_m: float = math.nan


@dataclass(frozen=True)
class LidarQuality:
    """Figures of the plate in a scan.

    Attributes:
        width_m, height_m: measured size of the plate.
        width_sigma_m, height_sigma_m: standard deviation of these.
        n_rings, n_points: number of rings and points on the plate.
        n_ring_ends: number of ring ends at its outline; without rings, of located border pieces of about 7
            cm.
        n_ring_ends_dropped: ring ends that do not fit the outline.
        plane_rms_m: rms of the points' distances from the plane.
        edge_rms_m: rms of the ring ends' distances from the outline; NaN without ring ends.
        template_m: error of the nominal outline.
        beyond_share: ratio of returns in the plane beyond the outline to those on the plate.
        distance_m: distance of the plate's middle.
    """

    width_m: float
    height_m: float
    width_sigma_m: float
    height_sigma_m: float
    n_rings: int
    n_points: int
    n_ring_ends: int
    n_ring_ends_dropped: int
    plane_rms_m: float
    edge_rms_m: float
    template_m: float
    beyond_share: float
    distance_m: float


@dataclass(frozen=True, eq=False)
class BoardPose:
    """The board's pose in the frame of the first of two sensors, a camera or a LiDAR.

    Attributes:
        T_cam_board: (4, 4), the likeliest pose.
        cov: (6, 6) of T_cam_board, tangent (translation m, rotation rad).
        T_cam_board_alternative: (4, 4) second pose that fits; None if there is none.
        chi2_gap: excess of the alternative's cost, in units of the noise's variance.
    """

    T_cam_board: Array
    cov: Array
    T_cam_board_alternative: Array | None
    chi2_gap: float

    @property
    def distance_m(self) -> float:
        """Distance of the board's origin from the sensor."""
        return float(np.linalg.norm(self.T_cam_board[:3, 3]))

    @property
    def tilt_deg(self) -> float:
        """Angle between the board's normal and the line of sight."""
        cosine = abs(float(self.T_cam_board[:3, 2] @ self.T_cam_board[:3, 3])) / self.distance_m
        return float(np.degrees(np.arccos(min(cosine, 1.0))))

    def figures(self) -> dict[str, float]:
        """List every figure by name, for tables and programs."""
        return {"tilt_deg": self.tilt_deg, "distance_m": self.distance_m}


@dataclass(frozen=True, eq=False)
class ImageBoard(BoardPose):
    """The board detected in one image; T_cam_board has the smaller reprojection error.

    Attributes:
        corners_px: (rows * cols, 2) in the order of `Board.corners()`; NaN where hidden, for boards
            with markers.
        reprojection_px: rms of the corner residuals.
        sigma_px: corner noise per coordinate, from the residuals and their degrees of freedom.
        quality: figures of the pattern in the image; None if only its corners are known.
        events: figures of the board's events; None if the image was not reconstructed from known events.
        stamp_ns: timestamp of the image; None if the recording carries no time.
        track_ns: (K,) int64 timestamps of further images of this channel, shortly before and after, in which
            the board was tracked; None if there are none.
        track_T_cam_board: (K, 4, 4) poses in these images, for the same order of corners.
        track_cov: (K, 6, 6) of those poses, as `cov`.
    """

    corners_px: Array
    reprojection_px: float
    sigma_px: float
    quality: ImageQuality | None = None
    events: EventQuality | None = None
    stamp_ns: int | None = None
    track_ns: NDArray[np.int64] | None = None
    track_T_cam_board: Array | None = None
    track_cov: Array | None = None

    def figures(self) -> dict[str, float]:
        """List every figure by name, for tables and programs."""
        figures = {} if self.quality is None else asdict(self.quality)
        figures["corner_rms_px"] = self.reprojection_px
        figures |= super().figures()
        measured = {} if self.events is None else asdict(self.events)
        return figures | {name: value for name, value in measured.items() if not math.isnan(value)}


@dataclass(frozen=True, eq=False)
class BoardSurface:
    """Points on the board in the frame of the second of two sensors.

    Attributes:
        points: (N, 3) on the board as measured, m.
        plane: (4,) as (n, d), n.p + d = 0, unit n towards the sensor (d > 0).
        T_lidar_board: (4, 4) of the board in the sensor's frame; a scan determines it up to the symmetries
            of a rectangle.
    """

    points: Array
    plane: Array
    T_lidar_board: Array

    def figures(self) -> dict[str, float]:
        """List every figure by name, for tables and programs."""
        return {"n_points": len(self.points), "distance_m": float(np.linalg.norm(self.T_lidar_board[:3, 3]))}


@dataclass(frozen=True, eq=False)
class LidarBoard(BoardSurface):
    """The board detected in one scan, frame lidar; T_lidar_board is from the template.

    Attributes:
        ring: (N,) int16 of each point.
        edge_points: (M, 3) first and last measured point of each ring on the board, m.
        edge_ring: (M,) int16.
        edge_side: (M,) int8, -1 where the board ends towards smaller azimuth, +1 towards larger
            (azimuth = atan2(y, x), counter-clockwise).
        edge_behind_m: (M,) distance behind the board's plane of the ring's next return beyond the edge; inf
            without one. An object close behind blends into the beam's return.
        edge_echo: (M,) fraction 0..1 of the received power from that object if a beam hits it and the board
            equally; 0 without an object. A beam that hits both reports the stronger echo.
        edge_beam_m: (M, 2) without rings: half the beam's width along the edge's normal, already
            subtracted from the edge points, as the sum of its width's and height's parts; None with rings.
        edge_sigma_m: (M,) noise of each edge point along the edge's normal beyond that of a sharp border,
            standard deviation; None where the whole border is sharp.
        azimuth_step_rad: angle between neighbouring firings of one ring.
        sigma_m: rms distance of `points` from the plane.
        offset_ns: (N,) int64 firing time of each point after the scan's timestamp; None without.
        quality: figures of the plate in the scan.
        stamp_ns: timestamp of the scan; None if the recording carries no time.
    """

    ring: NDArray[np.int16]
    edge_points: Array
    edge_ring: NDArray[np.int16]
    edge_side: NDArray[np.int8]
    edge_behind_m: Array
    edge_echo: Array
    azimuth_step_rad: float
    sigma_m: float
    quality: LidarQuality
    offset_ns: NDArray[np.int64] | None = None
    stamp_ns: int | None = None
    edge_beam_m: Array | None = None
    edge_sigma_m: Array | None = None

    def corrected(self, range_offset_m: float) -> "LidarBoard":
        """Subtract a constant from all ranges of the board, like `Scan.corrected` before detection.

        Args:
            range_offset_m: positive where ranges are too long.
        """
        T = self.T_lidar_board.copy()
        T[:3, 3] = shortened(T[None, :3, 3], range_offset_m)[0]
        points = shortened(self.points, range_offset_m)
        ends = shortened(self.edge_points, range_offset_m)
        plane, sigma_m = fit_plane(points)
        return replace(self, points=points, edge_points=ends, plane=plane, sigma_m=sigma_m, T_lidar_board=T)

    @property
    def has_rings(self) -> bool:
        """Whether the LiDAR scans in rings; else `points` are means and `edge_points` lie on the outline."""
        return len(self.ring) > 0 and int(self.ring[0]) != NO_RING

    def figures(self) -> dict[str, float]:
        """List every figure of the quality by name, for tables and programs."""
        return asdict(self.quality)


@dataclass(frozen=True, eq=False)
class PatternBoard(BoardSurface):
    """The board in an image of the second of two cameras, with its corners as points.

    Attributes:
        image: the detection.
    """

    image: ImageBoard

    @classmethod
    def of(cls, image: ImageBoard, corners: Array) -> "PatternBoard":
        """Place the corners of a board (N, 3), frame board, at its pose in an image.

        Args:
            image: the detection.
            corners: `Board.corners()`.
        """
        T, is_seen = image.T_cam_board, np.isfinite(image.corners_px[:, 0])
        normal = -T[:3, 2] * np.sign(T[:3, 2] @ T[:3, 3])
        points = corners[is_seen] @ T[:3, :3].T + T[:3, 3]
        return cls(points, np.append(normal, -normal @ T[:3, 3]), T, image)

    @classmethod
    def candidates(cls, image: ImageBoard, corners: Array) -> list["PatternBoard"]:
        """List the poses compatible with an image; arguments as in `of`."""
        poses = [image.T_cam_board]
        if image.T_cam_board_alternative is not None:
            poses.append(image.T_cam_board_alternative)
        return [cls.of(replace(image, T_cam_board=T), corners) for T in poses]


@dataclass(frozen=True, eq=False)
class Observation:
    """One board placement seen by two sensors: a camera channel and a LiDAR, or two sensors of one kind.

    Attributes:
        capture: the capture's name.
        pose: pose of the board in the first sensor.
        surface: surface of the board in the second.
        others: further places where the second sensor may see it.
    """

    capture: str
    pose: BoardPose
    surface: BoardSurface
    others: tuple[BoardSurface, ...] = ()

    @classmethod
    def of(cls, capture: str, pose: BoardPose, places: Sequence[BoardSurface]) -> "Observation":
        """Pair the first sensor's pose with the second sensor's candidates, best first."""
        return cls(capture, pose, places[0], tuple(places[1:]))

    @property
    def image(self) -> ImageBoard:
        """The board in the first sensor's image.

        Raises:
            TypeError: that sensor is a LiDAR.
        """
        if not isinstance(self.pose, ImageBoard):
            raise TypeError(f"{self.capture}: the first sensor is not a camera")
        return self.pose

    @property
    def lidar(self) -> LidarBoard:
        """The board in the second sensor's scan.

        Raises:
            TypeError: that sensor is a camera.
        """
        if not isinstance(self.surface, LidarBoard):
            raise TypeError(f"{self.capture}: the second sensor is not a LiDAR")
        return self.surface

    @property
    def places(self) -> tuple[BoardSurface, ...]:
        """All candidates of the board in the second sensor's data, best first."""
        return (self.surface, *self.others)
