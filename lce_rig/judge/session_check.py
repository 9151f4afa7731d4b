"""Compare extrinsics with the boards in every capture of a session."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.calibrate import Clocks
from lce_rig.calibrate.motion.board_motion import compensate, fit_motions, sample_poses
from lce_rig.calibrate.observations import SharedScan, scan_key
from lce_rig.calibrate.result import capture_residual, summarise
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration, CaptureResidual, ChannelResult, Metrics, SceneOpinion
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import BoardSurface, ImageBoard, LidarBoard, Observation
from lce_rig.detect.detection import Detections, ImageDetection, Pair
from lce_rig.detect.image.search import board_from_pose
from lce_rig.judge.findings import ELSEWHERE, UNSEEN
from lce_rig.judge.verdict import residuals_beyond, scene_findings
from lce_rig.lens.fit import board_shapes
from lce_rig.rig import Rig

# Boards displaced by slightly wrong extrinsics are measured; farther surfaces are other objects.
_ELSEWHERE_M = 0.5


@dataclass(frozen=True, eq=False)
class Meeting:
    """One capture's board, seen by both sensors at one time.

    Attributes:
        measured: as each sensor saw it, at its own time.
        at_scan_time: both at the time at which the LiDAR saw the board, for residuals.
        lidar_at_image_time: the LiDAR's at the time of the image, for drawing.
    """

    measured: Observation
    at_scan_time: Observation
    lidar_at_image_time: BoardSurface

    @property
    def way_m(self) -> float:
        """Distance that the board's centre moved between scan and image."""
        before, after = self.measured.surface.T_lidar_board, self.lidar_at_image_time.T_lidar_board
        return float(np.linalg.norm(after[:3, 3] - before[:3, 3]))


def bring_together(
    observations: Mapping[str, Sequence[Observation]],
    channel: str,
    T_cam_lidar: Array,
    results: Sequence[ChannelResult],
    clocks: Clocks,
) -> dict[str, Meeting]:
    """Compensate each capture for the board's motion between a channel's image and the scan.

    Args:
        observations: by channel of the calibration; other channels show how boards moved.
        channel: the channel of the captures.
        T_cam_lidar: (4, 4).
        results: the channels' time offsets; without any, boards are assumed to be still.
        clocks: as in the calibration.

    Returns:
        By name of the capture.
    """
    of_channel = {result.channel: result for result in results}
    timed = {name: items for name, items in observations.items() if name in of_channel}
    if channel not in timed or any(of_channel[name].time_offset_s is None for name in timed):
        return {o.capture: Meeting(o, o, o.surface) for o in observations.get(channel, ())}
    # Images of all channels by scan, those of the channel with the least noise first.
    by_scan: dict[bytes, dict[str, ImageBoard]] = {}
    for name in sorted(timed, key=lambda name: of_channel[name].noise_px):
        for o in timed[name]:
            by_scan.setdefault(scan_key(o), {}).setdefault(name, o.image)
    own = list(timed[channel])
    if not own:
        return {}
    # If several captures hold the same scan, use the capture's own image.
    scans = [SharedScan((o.capture,), {**by_scan[scan_key(o)], channel: o.image}, o.lidar) for o in own]
    samples = sample_poses(scans, clocks, {name: of_channel[name].noise_px for name in timed})
    offset_s = np.array([of_channel[name].time_offset_s for name in samples.channels], dtype=np.float64)
    only = channel if len(samples.channels) > 1 else None
    motions = fit_motions(samples, offset_s, only)
    swept = compensate(own, motions, T_cam_lidar, clocks.sweep_s)
    return {
        o.capture: Meeting(o, moved, _at_image_time(moved, o.image, T_cam_lidar))
        for o, moved in zip(own, swept, strict=True)
    }


def _at_image_time(swept: Observation, image: ImageBoard, T_cam_lidar: Array) -> LidarBoard:
    """Move the LiDAR's board from the time of the scan to that of the image."""
    moved = invert(T_cam_lidar) @ image.T_cam_board @ invert(swept.pose.T_cam_board) @ T_cam_lidar
    lidar = swept.lidar
    return replace(
        lidar,
        points=transform(moved, lidar.points),
        edge_points=transform(moved, lidar.edge_points),
        T_lidar_board=moved @ lidar.T_lidar_board,
    )


def match_candidates(candidates: Observation, board: Board, T_cam_lidar: Array) -> Observation:
    """Pair the candidates of one capture that are closest to each other under known extrinsics.

    Centres and normals decide, the angle weighted by the plate's half diagonal; rotations in the plane do not
    count, since a rectangle in a scan is symmetric.

    Args:
        candidates: detections of both sensors.
        board: the board's size weighs angles against distances.
        T_cam_lidar: (4, 4).
    """
    poses = [candidates.pose.T_cam_board]
    if candidates.pose.T_cam_board_alternative is not None:
        poses.append(candidates.pose.T_cam_board_alternative)
    arm_m = np.hypot(board.width_m, board.height_m) / 2

    def misfit(pair: tuple[int, int]) -> float:
        T_cam_board, lidar = poses[pair[0]], candidates.places[pair[1]]
        normal = T_cam_lidar[:3, :3] @ lidar.plane[:3]
        centre = transform(T_cam_lidar, lidar.T_lidar_board[None, :3, 3])[0]
        turn_m = arm_m * np.linalg.norm(normal - T_cam_board[:3, 2])
        return float(np.hypot(turn_m, np.linalg.norm(centre - T_cam_board[:3, 3])))

    pose_index, lidar_index = min(
        itertools.product(range(len(poses)), range(len(candidates.places))), key=misfit
    )
    pose = replace(candidates.pose, T_cam_board=poses[pose_index])
    return replace(candidates, pose=pose, surface=candidates.places[lidar_index], others=())


@dataclass(frozen=True, eq=False)
class SessionCheck:
    """Residuals of extrinsics for one channel and the LiDAR on the captures of a session.

    Attributes:
        pair: the sensors.
        calibration: the calibration to check.
        findings: why these captures contradict it; empty if they agree.
        residuals: residuals of each capture in which both sensors see the board.
        metrics: their summary; None without any.
        scene: the opinion of the scene's edges on the extrinsics.
        meetings: by capture, the boards of the residuals.
        page: shows the overlays of all captures, once they are drawn.
    """

    pair: Pair
    calibration: Calibration
    findings: tuple[Finding, ...]
    residuals: tuple[CaptureResidual, ...]
    metrics: Metrics | None
    scene: SceneOpinion
    meetings: Mapping[str, Meeting]
    page: Path | None = None

    def document(self) -> dict[str, Any]:
        """Return all figures as plain types for JSON."""
        names = ("plane_mean_m", "plane_rms_m", "edge_mean_m", "edge_rms_m", "reprojection_px")
        used = self.calibration.captures_used
        return {
            "camera": self.pair.camera,
            "channel": self.pair.channel,
            "lidar": self.pair.lidar,
            "verdict": self.calibration.verdict,
            "doubts": [doubt.as_json() for doubt in self.findings],
            "metrics": None
            if self.metrics is None
            else _finite({**asdict(self.metrics), "mge_m": self.metrics.mge_m}),
            "scene": {
                "state": self.scene.state,
                "n_captures": self.scene.n_captures,
                "n_edges": self.scene.n_edges,
                "change": None if self.scene.change is None else self.scene.change.tolist(),
                "covariance": None if self.scene.cov is None else self.scene.cov.tolist(),
            },
            "captures": {
                r.capture: {
                    "was_used": r.capture in used,
                    **_finite({name: getattr(r, name) for name in names}),
                }
                for r in self.residuals
            },
            "page": None if self.page is None else str(self.page),
        }


def _finite(figures: Mapping[str, float]) -> dict[str, float | None]:
    """Replace unknown figures by null, for JSON."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def check_session(
    rig: Rig,
    detections: Detections,
    calibration: Calibration,
    channel: str,
    scene: SceneOpinion,
) -> SessionCheck:
    """Measure the residuals of extrinsics for one channel and the LiDAR on every capture of a session.

    Boards are motion-compensated to the LiDAR's time if the calibration was.

    Args:
        rig: the session's.
        detections: detections of the session.
        calibration: the extrinsics; they may come from another session of the same rig.
        channel: one of the calibration's channels.
        scene: the opinion of this session's scene.
    """
    pair = replace(Pair.of(calibration), channel=channel)
    board, detections = rig.board.to_board(), seen_by_own_lens(rig, detections, calibration)
    meetings = find_meetings(rig, detections, pair, calibration.T_cam_lidar, calibration.channel_results)
    residuals = [
        capture_residual(calibration.T_cam_lidar, meeting.at_scan_time, board)
        for meeting in meetings.values()
    ]
    metrics = summarise(residuals) if residuals else None
    both = detections.between(pair, board).values()
    n_seen = sum(not any(isinstance(found, Refusal) for found in each) for each in both)
    findings = contradictions(metrics, rig, n_seen - len(residuals), n_seen)
    # A result of this session has been judged by its scene; that of another may have been deployed since.
    action = "" if calibration.captures_used else "deployed"
    findings = (*findings, *scene_findings(scene, calibration, action))
    return SessionCheck(pair, calibration, findings, tuple(residuals), metrics, scene, meetings)


def seen_by_own_lens(rig: Rig, detections: Detections, calibration: Calibration) -> Detections:
    """Solve the boards' poses in images of a result's cameras again, with the result's lenses and board.

    Poses of moving boards, which come with those of further images, are kept.
    """
    c, lenses = calibration, {}
    for name, lens in ((c.camera, c.intrinsics), (c.lidar, c.lidar_intrinsics)):
        if lens is not None:
            lenses[name] = lens
    if not lenses:
        return detections
    board = rig.board.to_board()
    corners = replace(board, square_m=calibration.square_m or board.square_m).corners()
    if calibration.board_shape is not None:
        corners = corners + np.tensordot(calibration.board_shape, board_shapes(board)[0], axes=1)

    def again(image: ImageDetection, lens: Intrinsics) -> ImageDetection:
        if not isinstance(image, ImageBoard) or image.track_ns is not None:
            return image
        solved = solve_planar_pose(image.corners_px, corners, lens)
        if solved is None:
            return image
        seen = board_from_pose(image.corners_px, solved, image.quality)
        return replace(seen, events=image.events, stamp_ns=image.stamp_ns)

    images = {
        (camera, channel): {name: again(image, lenses[camera]) for name, image in of_channel.items()}
        if camera in lenses
        else of_channel
        for (camera, channel), of_channel in detections.images.items()
    }
    return replace(detections, images=images)


def contradictions(metrics: Metrics | None, rig: Rig, n_elsewhere: int, n_seen: int) -> tuple[Finding, ...]:
    """Find contradictions of captures and extrinsics: large residuals, or no board at the expected place.

    Args:
        metrics: metrics of the captures in which both sensors agree on the board's place; None without any.
        rig: the profile with the limits.
        n_elsewhere: captures without a surface in the scan near the camera's detection. One such capture may
            be a board that the LiDAR missed among objects of its size; many are a contradiction.
        n_seen: captures with detections of both sensors.
    """
    found = [] if metrics is None else residuals_beyond(metrics, rig.quality)
    if 4 * n_elsewhere > n_seen:
        found.append(ELSEWHERE(n_elsewhere=n_elsewhere, n_captures=n_seen))
    if n_seen == 0:
        found.append(UNSEEN())
    return tuple(found)


def find_meetings(
    rig: Rig,
    detections: Detections,
    pair: Pair,
    T_cam_lidar: Array,
    results: Sequence[ChannelResult],
) -> dict[str, Meeting]:
    """Match both sensors' boards in each capture of a channel in which they agree.

    Args:
        rig: the profile.
        detections: detections of the captures.
        pair: the sensors.
        T_cam_lidar: (4, 4) the extrinsics.
        results: results of the channels of the calibration.

    Returns:
        By name of the capture.
    """
    board, clocks = rig.board.to_board(), Clocks.of(rig, pair.camera, pair.lidar)
    observations: dict[str, list[Observation]] = {}
    for name in sorted({pair.channel, *(result.channel for result in results)}):
        of_channel = replace(pair, channel=name)
        if not detections.captures(of_channel):
            continue
        observations[name] = []
        for candidates in detections.candidates(of_channel, board)[0]:
            matched = match_candidates(candidates, board, T_cam_lidar)
            middle = T_cam_lidar @ matched.surface.T_lidar_board[:, 3]
            if np.linalg.norm(middle[:3] - matched.pose.T_cam_board[:3, 3]) < _ELSEWHERE_M:
                observations[name].append(matched)
    return bring_together(observations, pair.channel, T_cam_lidar, results, clocks)
