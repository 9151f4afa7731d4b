"""The data passed between stages, as frozen dataclasses."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.diagnostics import NO_DIAGNOSTICS, Diagnostics
from lce_rig.core.findings import Figure, Finding, Refusal
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.core.scene_opinion import SceneOpinion

Method = Literal["ml", "paper"]
DEFAULT_METHOD: Method = "ml"
"""How extrinsics are estimated: the joint maximum likelihood, or Algorithm 1 of LCE-Calib."""


@dataclass(frozen=True)
class ImageQuality:
    """What an image shows of the pattern.

    Attributes:
        mean_grey: of the whole image, grey values.
        contrast: white minus black squares, grey values.
        noise: standard deviation, grey values.
        square_px: shortest side of a square.
        edge_width_px: of the squares' edges, 10-90 %.
        sharpness: edge widths in a square: 1 is unreadable, above 5 is crisp.
        border_px: outermost corner to the border of the image.
        n_corners: that could be fitted.
    """

    mean_grey: float
    contrast: float
    noise: float
    square_px: float
    edge_width_px: float
    sharpness: float
    border_px: float
    n_corners: int


@dataclass(frozen=True)
class EventQuality:
    """What events show of the board and of its motion; NaN if it could not be measured.

    Attributes:
        events_px_s: events per second and pixel of the board, just before the image.
        events_px: events per pixel of the board in the time that the network remembers.
        speed_mps, turn_deg_s: of the board about the time of the image.
        speed_sigma_mps, turn_sigma_deg_s: standard deviation of these.
        smear_m: how far the board moves while the LiDAR scans it.
        smear_depth_m: the part of it along the board's normal, which thickens or tilts the plane.
    """

    events_px_s: float
    events_px: float
    speed_mps: float = math.nan
    speed_sigma_mps: float = math.nan
    turn_deg_s: float = math.nan
    turn_sigma_deg_s: float = math.nan
    smear_m: float = math.nan
    smear_depth_m: float = math.nan


@dataclass(frozen=True)
class LidarQuality:
    """What a scan shows of the plate.

    Attributes:
        width_m, height_m: of the plate as measured.
        width_sigma_m, height_sigma_m: standard deviation of these.
        size_ratio: both sides together over the nominal ones.
        n_rings, n_points: on the plate.
        n_ring_ends: at its outline.
        n_ring_ends_dropped: that do not fit the outline.
        plane_rms_m: rms of the points' distances from the plane.
        edge_rms_m: of the ring ends' distances from the outline; NaN without ring ends.
        template_m: error of the nominal outline.
        beyond_share: returns in the plane beyond the outline over those on the plate.
        distance_m: of the plate's middle.
        incidence_deg: between the beam and the plate's normal there.
        range_noise_m: of the whole scan.
    """

    width_m: float
    height_m: float
    width_sigma_m: float
    height_sigma_m: float
    size_ratio: float
    n_rings: int
    n_points: int
    n_ring_ends: int
    n_ring_ends_dropped: int
    plane_rms_m: float
    edge_rms_m: float
    template_m: float
    beyond_share: float
    distance_m: float
    incidence_deg: float
    range_noise_m: float


@dataclass(frozen=True, eq=False)
class ImageBoard:
    """The board detected in one image.

    Attributes:
        corners_px: (rows * cols, 2) in the order of `Board.corners()`.
        T_cam_board: (4, 4), the pose with the smaller reprojection error.
        cov: (6, 6) of T_cam_board, tangent (translation m, rotation rad).
        T_cam_board_alternative: (4, 4) second local minimum; None if there is none in front of the camera.
        chi2_gap: by how much the alternative's cost is higher, in units of the corner variance.
        is_ambiguous: whether the image alone cannot decide between the two (chi2_gap < 9).
        reprojection_px: rms of the corner residuals.
        sigma_px: corner noise per coordinate, from the residuals and their degrees of freedom.
        quality: figures of the pattern in the image; None if only its corners are known.
        events: figures of the board's events; None if the image was not reconstructed from known events.
        stamp_ns: of the image; None if the recording carries no time.
        track_ns: (K,) int64 timestamps of further images of this channel, shortly before and after, in which
            the board was tracked; None if there are none.
        track_T_cam_board: (K, 4, 4) its poses there, corners in the same order as here.
        track_cov: (K, 6, 6) of those poses, as `cov`.
    """

    corners_px: Array
    T_cam_board: Array
    cov: Array
    T_cam_board_alternative: Array | None
    chi2_gap: float
    is_ambiguous: bool
    reprojection_px: float
    sigma_px: float
    quality: ImageQuality | None = None
    events: EventQuality | None = None
    stamp_ns: int | None = None
    track_ns: NDArray[np.int64] | None = None
    track_T_cam_board: Array | None = None
    track_cov: Array | None = None

    @property
    def distance_m(self) -> float:
        """Distance of the pattern's middle from the camera."""
        return float(np.linalg.norm(self.T_cam_board[:3, 3]))

    @property
    def tilt_deg(self) -> float:
        """Angle between the board's normal and the line of sight."""
        cosine = abs(float(self.T_cam_board[:3, 2] @ self.T_cam_board[:3, 3])) / self.distance_m
        return float(np.degrees(np.arccos(min(cosine, 1.0))))

    def figures(self) -> dict[str, float]:
        """List every figure by name, for tables and programs."""
        figures = {} if self.quality is None else asdict(self.quality)
        figures["corner_rms_px"] = self.reprojection_px
        figures |= {"tilt_deg": self.tilt_deg, "distance_m": self.distance_m}
        measured = {} if self.events is None else asdict(self.events)
        return figures | {name: value for name, value in measured.items() if not math.isnan(value)}


@dataclass(frozen=True, eq=False)
class LidarBoard:
    """The board detected in one scan, frame lidar.

    Attributes:
        points: (N, 3) on the board as measured, m.
        ring: (N,) int16 of each point.
        edge_points: (M, 3) first and last point of each ring on the board, as measured, m.
        edge_ring: (M,) int16.
        edge_side: (M,) int8, -1 where the board ends towards smaller azimuth, +1 towards larger
            (azimuth = atan2(y, x), counter-clockwise).
        edge_behind_m: (M,) how far behind the board's plane the ring's next return beyond the edge lies;
            inf if there is none. What stands close behind blends into the beam's return.
        edge_echo: (M,) share 0..1 of the received power that comes from there where a beam meets it and the
            board alike; 0 where nothing is there. A beam that meets both reports the stronger echo.
        azimuth_step_rad: angle between neighbouring firings of one ring.
        plane: (4,) as (n, d), n.p + d = 0, unit n towards the LiDAR (d > 0).
        sigma_m: rms distance of `points` from the plane.
        T_lidar_board: (4, 4) from the template; known up to the symmetries of a rectangle.
        offset_ns: (N,) int64 firing time of each point after the scan's timestamp; None without.
        quality: figures of the plate in the scan.
        stamp_ns: of the scan; None if the recording carries no time.
    """

    points: Array
    ring: NDArray[np.int16]
    edge_points: Array
    edge_ring: NDArray[np.int16]
    edge_side: NDArray[np.int8]
    edge_behind_m: Array
    edge_echo: Array
    azimuth_step_rad: float
    plane: Array
    sigma_m: float
    T_lidar_board: Array
    quality: LidarQuality
    offset_ns: NDArray[np.int64] | None = None
    stamp_ns: int | None = None

    def figures(self) -> dict[str, float]:
        """List every figure of the quality by name, for tables and programs."""
        return asdict(self.quality)


@dataclass(frozen=True, eq=False)
class Observation:
    """One board placement seen by one camera channel and one LiDAR; of several sessions, also its session."""

    capture: str
    image: ImageBoard
    lidar: LidarBoard
    session: str = ""


@dataclass(frozen=True)
class Certificate:
    """Proof that a pose is the global minimum of its cost.

    Attributes:
        is_optimal: whether the gap is below the tolerance.
        gap: bound on (cost - global minimum) / cost; infinite where the method has none.
    """

    is_optimal: bool
    gap: float


@dataclass(frozen=True)
class Metrics:
    """Errors of the extrinsics; docs/conventions.md defines them.

    Attributes:
        mpe_m: mean over captures of the mean distance of LiDAR board points from the camera's board plane.
        mee_m: mean over captures of the mean distance of ring ends from the board's edges.
        mge_m: mpe_m + mee_m.
        reprojection_px: rms corner residual of the board poses.
    """

    mpe_m: float
    mee_m: float
    reprojection_px: float

    @property
    def mge_m(self) -> float:
        """Mean geometric error, the paper's summary figure."""
        return self.mpe_m + self.mee_m


@dataclass(frozen=True, eq=False)
class ChannelResult:
    """The result of one channel of a camera alone, with its time offset.

    Attributes:
        channel: its name.
        n_captures: captures in which it shows the board and agrees with the others.
        noise_px: corner noise per coordinate, from the residuals of all its images.
        T_cam_lidar: (4, 4) extrinsic from this channel's images; from others' only how boards moved.
        cov: (6, 6) of it, as `Calibration.cov`.
        depth_scatter_m: standard deviation over captures of the LiDAR's distance from the board's plane.
        depth_scatter_still_m: the same if boards are taken to have stood still.
        time_offset_s: what to add to its timestamps beyond the profile's expected offset to come to the
            LiDAR's time; images without timestamps count from the scan's first firing. None if nothing moved.
        time_offset_sigma_s: standard deviation of that.
    """

    channel: str
    n_captures: int
    noise_px: float
    T_cam_lidar: Array
    cov: Array
    depth_scatter_m: float
    depth_scatter_still_m: float
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None


@dataclass(frozen=True)
class PointUncertainty:
    """Errors of the LiDAR's points in the camera: standard deviations of the error's size.

    Attributes:
        distance_m: of the point from the camera.
        centre_px, centre_m: in the middle of the image; in it, and in space.
        corner_px, corner_m: in the least certain corner.
    """

    distance_m: float
    centre_px: float
    centre_m: float
    corner_px: float
    corner_m: float


@dataclass(frozen=True)
class Contribution:
    """One cause of the standard deviations of extrinsics; the squares of all causes add up.

    Attributes:
        source: "captures" (their scatter), "lidar_ranges", an error of the profile's lens or board such as
            "focal_length" or "square_size", or "contradiction_" with the check that contradicts.
        sigma_rotation_deg, sigma_translation_m: what it contributes.
    """

    source: str
    sigma_rotation_deg: float
    sigma_translation_m: float


@dataclass(frozen=True, eq=False)
class OtherCamera:
    """The pose of a camera relative to another one that saw the same boards in the same scans.

    Attributes:
        camera: name of the other one.
        n_captures: that both used.
        T_cam_other: (4, 4) to which the extrinsics of both with the LiDAR compose, p_cam = R p_other + t.
        cov: (6, 6) of it, tangent (translation m, rotation rad), axes of the camera; None if the
            extrinsics were not estimated together.
        T_cam_other_pictures: (4, 4) from the images of both alone; None if too few boards tell.
        apart_rotation_deg, apart_translation_m: how far that lies from what the extrinsics compose to, each
            estimated separately.
        board_rms_m: how far apart those put the middle of the same board, rms.
    """

    camera: str
    n_captures: int
    T_cam_other: Array
    cov: Array | None
    T_cam_other_pictures: Array | None
    apart_rotation_deg: float | None
    apart_translation_m: float | None
    board_rms_m: float


@dataclass(frozen=True)
class CaptureResidual:
    """How well one capture fits extrinsics.

    Attributes:
        capture: its name.
        plane_mean_m, plane_rms_m: distance of the LiDAR's board points from the camera's board plane.
        edge_mean_m, edge_rms_m: distance in the board's plane of ring ends from the board's edges.
        held_out_m: rms of both where the capture was not fitted; NaN without draws.
        reprojection_px: rms corner residual of the board's pose.
    """

    capture: str
    plane_mean_m: float
    plane_rms_m: float
    edge_mean_m: float
    edge_rms_m: float
    held_out_m: float
    reprojection_px: float


Motion = Literal["translation_x", "translation_y", "translation_z", "rotation_x", "rotation_y", "rotation_z"]
MOTIONS: tuple[Motion, ...] = (
    "translation_x",
    "translation_y",
    "translation_z",
    "rotation_x",
    "rotation_y",
    "rotation_z",
)
"""Motions along and about the camera's axes, in the order of a tangent (6,)."""


@dataclass(frozen=True)
class WeakestMotion:
    """The motion of an extrinsic that its captures determine least.

    Attributes:
        motion: its main component, axes of the camera.
        sigma: standard deviation of that, m or rad.
    """

    motion: Motion
    sigma: float

    @property
    def is_rotation(self) -> bool:
        """Whether the motion is a rotation."""
        return MOTIONS.index(self.motion) >= 3

    def figures(self) -> dict[str, Figure]:
        """Give motion and standard deviation as figures of a finding."""
        if self.is_rotation:
            return {"weakest": self.motion, "weakest_sigma_deg": math.degrees(self.sigma)}
        return {"weakest": self.motion, "weakest_sigma_m": self.sigma}


@dataclass(frozen=True, eq=False)
class SceneShare:
    """What the edges of the scene did to extrinsics that boards gave.

    Attributes:
        state: "used", or why the extrinsics are those of the boards alone: the scene "contradicts" them
            beyond what both claim, or is "unknown", showing nothing that the boards do not show better.
        n_captures, n_edges: of the scene.
        T_cam_lidar, cov: (4, 4), (6, 6) by boards and scene, used or not.
        T_cam_lidar_boards, cov_boards: by the boards alone.
        change: (6,) tangent from the boards' extrinsics to those of both, m and rad, axes of the camera.
        change_sigma: (6,) standard deviation that it should have.
        surprise: its square in units of that, over `n_directions`: chi-squared if both are right.
        n_directions: in which the scene knows anything, of six.
    """

    state: Literal["used", "contradicts", "unknown"]
    n_captures: int
    n_edges: int
    T_cam_lidar: Array
    cov: Array
    T_cam_lidar_boards: Array
    cov_boards: Array
    change: Array
    change_sigma: Array
    surprise: float
    n_directions: int


class Extrinsics(Protocol):
    """What other evidence needs of extrinsics that boards gave, judged or not; fields as of `Calibration`."""

    @property
    def camera(self) -> str:
        """Name of the camera."""

    @property
    def lidar(self) -> str:
        """Name of the LiDAR."""

    @property
    def T_cam_lidar(self) -> Array:
        """(4, 4)."""

    @property
    def cov(self) -> Array:
        """(6, 6)."""

    @property
    def cov_shared(self) -> Array:
        """(6, 6)."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The extrinsics of one camera and one LiDAR, with everything needed to judge it.

    result.json keeps all of it but the last eight attributes, which are empty if it is read back.

    Attributes:
        channels: of the camera, names.
        channel_results: what each of these says alone.
        T_cam_lidar: (4, 4), p_cam = R p_lidar + t.
        cov: (6, 6), tangent (translation m, rotation rad), axes of the camera.
        cov_shared: (6, 6) the part of it that all sessions of one lens and board have in common, as the
            profile states these; zero if unknown.
        contributions: the causes of `cov`, the largest first.
        egt_rotation_deg, egt_translation_m: error against a reference given by the user; None without.
        verdict: "pass", "marginal" or "fail".
        findings: the reasons for it, worst first, and notes.
        captures_used: names of the captures behind the estimate.
        captures_refused: why each other capture is not.
        diagnostics: further figures.
        method: that found the extrinsics, as `CalibrateOptions.method`.
        uncertainty: what `cov` means for points at several distances; empty if no lens was at hand.
        estimated_with: cameras whose extrinsics were estimated together with this one.
        other_cameras: those that saw the same boards held still.
        scene_share: what the scene did to them; None if it was not asked.
        scene: what the edges of the scene say of it; None if they were not compared.
        weakest: the least determined motion; None if it is read back.
        held_out_m: rms residual of captures where they were not fitted; NaN if no method knows it.
        residuals: of each capture used.
        observations: capture -> the boards that were paired, as measured, for each capture used.
        lens_error, lens_error_sigma: errors of the profile's intrinsics as the boards see them, given less
            seen: focal length (relative), principal point x and y (px), distortion (px in the image's
            corner); their standard deviations.
        laser_range_m, laser_range_sigma_m: range offset of each of the LiDAR's lasers, by ring; its standard
            deviation about their mean. Empty where the method knows none, the boards moved, or the profile
            states them.
    """

    camera: str
    channels: tuple[str, ...]
    lidar: str
    T_cam_lidar: Array
    cov: Array
    certificate: Certificate
    metrics: Metrics
    n_captures: int
    n_detected: int
    captures_used: tuple[str, ...]
    captures_refused: Mapping[str, Refusal]
    verdict: Literal["pass", "marginal", "fail"]
    findings: tuple[Finding, ...] = ()
    egt_rotation_deg: float | None = None
    egt_translation_m: float | None = None
    diagnostics: Diagnostics = NO_DIAGNOSTICS
    channel_results: tuple[ChannelResult, ...] = ()
    method: str = "paper"
    uncertainty: tuple[PointUncertainty, ...] = ()
    estimated_with: tuple[str, ...] = ()
    other_cameras: tuple[OtherCamera, ...] = ()
    cov_shared: Array = field(default_factory=lambda: np.zeros((6, 6)))
    contributions: tuple[Contribution, ...] = ()
    scene_share: SceneShare | None = None
    scene: SceneOpinion | None = None
    weakest: WeakestMotion | None = None
    held_out_m: float = float("nan")
    residuals: tuple[CaptureResidual, ...] = ()
    observations: Mapping[str, Observation] = field(default_factory=dict)
    lens_error: tuple[float, ...] = ()
    lens_error_sigma: tuple[float, ...] = ()
    laser_range_m: tuple[float, ...] = ()
    laser_range_sigma_m: tuple[float, ...] = ()

    @property
    def is_start_certified(self) -> bool:
        """Whether the certificate is of Algorithm 1's solution, where the estimate starts, not of its own."""
        return self.method != "paper"

    @property
    def channel(self) -> str:
        """Names of the channels for people: several are joined by "+"."""
        return "+".join(self.channels)

    @property
    def sigma_rotation_deg(self) -> float:
        """Root of the summed rotation variances, deg."""
        return sigma_sizes(self.cov)[0]

    @property
    def sigma_translation_m(self) -> float:
        """Root of the summed translation variances, m."""
        return sigma_sizes(self.cov)[1]
