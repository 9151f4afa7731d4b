"""Compare extrinsics with every capture of a session: residuals, one image each, one contact sheet."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.calibrate import Clocks
from lce_rig.calibrate.metrics import capture_residual, summarise
from lce_rig.calibrate.motion.board_motion import fit_motions
from lce_rig.calibrate.motion.time_offsets import at_scan_time, deskew_points
from lce_rig.calibrate.options import CaptureCandidates
from lce_rig.calibrate.shared_scans import SharedScan, sample_scans
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration, CaptureResidual, Metrics, SceneOpinion
from lce_rig.core.data import Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.results import ImageBoard, LidarBoard, Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.findings import ELSEWHERE, UNSEEN
from lce_rig.judge.verdict import residuals_beyond, scene_findings
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.show.overlays.event_picture import ImageWithEvents
from lce_rig.show.overlays.overlay import camera_part, draw_overlay, range_limits
from lce_rig.show.overlays.overlay_files import Overlay, SheetHead, write_overlays
from lce_rig.words import as_json, sentence

# Boards that moved between image and scan, motion-compensated as in the calibration.


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
    lidar_at_image_time: LidarBoard

    @property
    def way_m(self) -> float:
        """Distance that the board's middle moved between scan and image."""
        before, after = self.measured.lidar.T_lidar_board, self.lidar_at_image_time.T_lidar_board
        return float(np.linalg.norm(after[:3, 3] - before[:3, 3]))


def bring_together(
    observations: Mapping[str, Sequence[Observation]], channel: str, calibration: Calibration, clocks: Clocks
) -> dict[str, Meeting]:
    """Compensate each capture for the board's motion between a channel's image and the scan.

    Args:
        observations: by channel of the calibration; other channels show how boards moved.
        channel: the channel of the captures.
        calibration: with its channels' time offsets; without any, boards are assumed to be still.
        clocks: as in the calibration.

    Returns:
        By name of the capture.
    """
    results = {result.channel: result for result in calibration.channel_results}
    timed = {name: items for name, items in observations.items() if name in results}
    if channel not in timed or any(results[name].time_offset_s is None for name in timed):
        return {o.capture: Meeting(o, o, o.lidar) for o in observations.get(channel, ())}
    scans, own = _join(timed, channel, sorted(timed, key=lambda name: results[name].noise_px))
    if not own:
        return {}
    samples = sample_scans(scans, clocks, {name: results[name].noise_px for name in timed})
    offset_s = np.array([results[name].time_offset_s for name in samples.channels], dtype=np.float64)
    only = channel if len(samples.channels) > 1 else None
    motions = fit_motions(samples, offset_s, only)
    swept = deskew_points(at_scan_time(own, motions, clocks.sweep_s), motions, calibration.T_cam_lidar)
    return {
        o.capture: Meeting(o, moved, _at_image_time(moved, o.image, calibration.T_cam_lidar))
        for o, moved in zip(own, swept, strict=True)
    }


def _join(
    observations: Mapping[str, Sequence[Observation]], channel: str, steadiest_first: Sequence[str]
) -> tuple[list[SharedScan], list[Observation]]:
    """Collect, for each of a channel's observations, the images of all channels with the same scan."""
    by_scan: dict[bytes, dict[str, ImageBoard]] = {}
    for name in steadiest_first:
        for o in observations[name]:
            by_scan.setdefault(o.lidar.points.tobytes(), {}).setdefault(name, o.image)
    own = list(observations[channel])
    scans = []
    for o in own:
        # This capture's own image, if several hold the same scan.
        images = {**by_scan[o.lidar.points.tobytes()], channel: o.image}
        scans.append(SharedScan((o.capture,), images, o.lidar))
    return scans, own


def _at_image_time(swept: Observation, image: ImageBoard, T_cam_lidar: Array) -> LidarBoard:
    """Move the LiDAR's board from the time of the scan to that of the image."""
    moved = invert(T_cam_lidar) @ image.T_cam_board @ invert(swept.image.T_cam_board) @ T_cam_lidar
    lidar = swept.lidar
    return replace(
        lidar,
        points=transform(moved, lidar.points),
        edge_points=transform(moved, lidar.edge_points),
        T_lidar_board=moved @ lidar.T_lidar_board,
    )


# Matching of a capture's LiDAR candidates and camera poses under given extrinsics.


def match_candidates(candidates: CaptureCandidates, board: Board, T_cam_lidar: Array) -> Observation:
    """Pair the candidates of one capture that are closest to each other under known extrinsics.

    Centres and normals decide, the angle weighted by the plate's half diagonal; rotations in the plane do not
    count, since a scan cannot tell a rectangle's.

    Args:
        candidates: detections of both sensors.
        board: its size weighs angles against distances.
        T_cam_lidar: (4, 4).
    """
    poses = [candidates.image.T_cam_board]
    if candidates.image.T_cam_board_alternative is not None:
        poses.append(candidates.image.T_cam_board_alternative)
    arm_m = np.hypot(board.width_m, board.height_m) / 2

    def misfit(pair: tuple[int, int]) -> float:
        T_cam_board, lidar = poses[pair[0]], candidates.lidar[pair[1]]
        normal = T_cam_lidar[:3, :3] @ lidar.plane[:3]
        centre = transform(T_cam_lidar, lidar.T_lidar_board[None, :3, 3])[0]
        turn_m = arm_m * np.linalg.norm(normal - T_cam_board[:3, 2])
        return float(np.hypot(turn_m, np.linalg.norm(centre - T_cam_board[:3, 3])))

    pose_index, lidar_index = min(
        itertools.product(range(len(poses)), range(len(candidates.lidar))), key=misfit
    )
    image = replace(candidates.image, T_cam_board=poses[pose_index])
    return Observation(candidates.capture, image, candidates.lidar[lidar_index])


Progress = Callable[[int, int], None]
# Boards displaced by slightly wrong extrinsics are measured; farther surfaces are other objects.
_ELSEWHERE_M = 0.5
# Scans that choose the range scale of a session's images.
_SCANS_OF_SCALE = 8


@dataclass(frozen=True, eq=False)
class SessionCheck:
    """Residuals of extrinsics for one channel and the LiDAR on the captures of a session.

    Attributes:
        pair: the sensors.
        calibration: the calibration to check.
        findings: why these captures contradict it; empty if they agree.
        residuals: of each capture in which both sensors see the board.
        metrics: their summary; None without any.
        scene: what the edges of the scene say of the extrinsics.
        meetings: by capture, the boards of the residuals.
        pictures: one per capture, once they are drawn.
        contact_sheets: all of them, on one sheet or more.
    """

    pair: Pair
    calibration: Calibration
    findings: tuple[Finding, ...]
    residuals: tuple[CaptureResidual, ...]
    metrics: Metrics | None
    scene: SceneOpinion
    meetings: Mapping[str, Meeting]
    pictures: tuple[Path, ...] = ()
    contact_sheets: tuple[Path, ...] = ()

    def moved(self, old: Path, new: Path) -> "SessionCheck":
        """Update the files' paths to a new folder."""

        def renamed(path: Path) -> Path:
            return new / path.relative_to(old)

        pictures, sheets = (tuple(map(renamed, paths)) for paths in (self.pictures, self.contact_sheets))
        return replace(self, pictures=pictures, contact_sheets=sheets)

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "camera": self.pair.camera,
            "channel": self.pair.channel,
            "lidar": self.pair.lidar,
            "verdict": self.calibration.verdict,
            "doubts": [as_json(doubt) for doubt in self.findings],
            "metrics": None
            if self.metrics is None
            else {**asdict(self.metrics), "mge_m": self.metrics.mge_m},
            "scene": {"state": self.scene.state, **asdict(self.scene)},
            "captures": {r.capture: _figures(r, self.calibration.captures_used) for r in self.residuals},
            "pictures": [str(path) for path in self.pictures],
            "contact_sheets": [str(path) for path in self.contact_sheets],
        }


def _figures(residual: CaptureResidual, used: tuple[str, ...]) -> dict[str, Any]:
    names = ("plane_mean_m", "plane_rms_m", "edge_mean_m", "edge_rms_m", "reprojection_px")
    return {"was_used": residual.capture in used, **{name: getattr(residual, name) for name in names}}


def check_session(
    rig: Rig,
    detections: Detections,
    calibration: Calibration,
    channel: str,
    clocks: Clocks,
    scene: SceneOpinion,
) -> SessionCheck:
    """Measure the residuals of extrinsics for one channel and the LiDAR on every capture of a session.

    Boards are motion-compensated to the LiDAR's time if the calibration was.

    Args:
        rig: the session's.
        detections: of the session.
        calibration: the extrinsics; they may come from another session of the same rig.
        channel: of the calibration's channels.
        clocks: the profile's settings of the two sensors' times.
        scene: the opinion of this session's scene.
    """
    pair = Pair(calibration.camera, channel, calibration.lidar)
    board = rig.board.to_board()
    meetings = find_meetings(rig, detections, channel, calibration, clocks)
    residuals = [
        capture_residual(calibration.T_cam_lidar, meeting.at_scan_time, board)
        for meeting in meetings.values()
    ]
    metrics = summarise(residuals) if residuals else None
    n_seen = sum(_sees_board(detections, pair, name) for name in detections.captures(pair))
    findings = contradictions(metrics, rig, n_seen - len(residuals), n_seen)
    # A result of this session has been judged by its scene; that of another may have been deployed since.
    action = "" if calibration.captures_used else "deployed"
    findings = (*findings, *scene_findings(scene, calibration, action))
    return SessionCheck(pair, calibration, findings, tuple(residuals), metrics, scene, meetings)


def draw_check(
    session: Session,
    detections: Detections,
    check: SessionCheck,
    folder: Path,
    *,
    view_of: Callable[[Capture], ImageWithEvents | None],
    progress: Progress,
) -> SessionCheck:
    """Project the point cloud of every capture into its image, and return the images' paths.

    Args:
        session: the source of the captures.
        detections: of the session.
        check: of one channel on these captures.
        folder: receives `<capture>.png` and contact sheets.
        view_of: returns the channel's image in a capture; None if it cannot be read.
        progress: called with (done, total).

    Raises:
        SessionError: an image cannot be written.
    """
    residuals = {residual.capture: residual for residual in check.residuals}
    names = detections.captures(check.pair)
    limits_m = _range_limits(session, check.pair.lidar, names)

    def overlays() -> Iterator[Overlay]:
        for done, name in enumerate(names, start=1):
            capture = session.capture(name)
            view = view_of(capture)
            if view is not None:
                seen = detections.of(check.pair, name)[0]
                image = seen if isinstance(seen, ImageBoard) else None
                yield from _draw(capture, session.rig, check, view, image, residuals.get(name), limits_m)
            progress(done, len(names))

    head = SheetHead(
        f"{session.rig.name}  {check.pair}",
        check.calibration.verdict,
        _head_lines(check, len(names)),
        limits_m,
    )
    pictures, sheets = write_overlays(folder, overlays(), head)
    return replace(check, pictures=tuple(pictures), contact_sheets=tuple(sheets))


def _range_limits(session: Session, lidar: str, names: Sequence[str]) -> tuple[float, float]:
    """Choose one range scale for all images of a session from scans throughout it."""
    scans = []
    for name in names[:: max(1, len(names) // _SCANS_OF_SCALE)]:
        with suppress(SessionError):
            scans.append(session.capture(name).scan(lidar))
    return range_limits(scans)


def _head_lines(check: SessionCheck, n_captures: int) -> list[str]:
    """State the figures of all captures, and what speaks against the extrinsics."""
    c, m = check.calibration, check.metrics
    lines = [
        f"{n_captures} captures, {len(c.captures_used)} used; "
        f"uncertainty {c.sigma_rotation_deg:.2g} deg, {1000 * c.sigma_translation_m:.2g} mm (1 sigma)"
        + (
            ""
            if m is None
            else f"; mean over captures: {_residual_words(m.mpe_m, m.mee_m, m.reprojection_px)}"
        )
    ]
    return lines + [sentence(finding) for finding in (*c.findings, *check.findings)]


def _residual_words(plane_m: float, edge_m: float, corner_px: float) -> str:
    return f"planes {1000 * plane_m:.1f} mm, edges {1000 * edge_m:.1f} mm, corners {corner_px:.2f} px"


def contradictions(metrics: Metrics | None, rig: Rig, n_elsewhere: int, n_seen: int) -> tuple[Finding, ...]:
    """Find contradictions of captures and extrinsics: large residuals, or no board at the expected place.

    Args:
        metrics: of the captures in which both sensors agree on the board's place; None without any.
        rig: its limits.
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


def _sees_board(detections: Detections, pair: Pair, name: str) -> bool:
    image, lidar = detections.of(pair, name)
    return isinstance(image, ImageBoard) and isinstance(lidar, list)


def find_meetings(
    rig: Rig, detections: Detections, channel: str, calibration: Calibration, clocks: Clocks
) -> dict[str, Meeting]:
    """Match both sensors' boards in each capture of a channel in which they agree.

    Args:
        rig: the profile.
        detections: of the captures.
        channel: of the camera.
        calibration: the extrinsics.
        clocks: the profile's settings of the two sensors' times.

    Returns:
        By name of the capture.
    """
    observations = {}
    for name in calibration.channels:
        pair = Pair(calibration.camera, name, calibration.lidar)
        if pair in detections.pairs:
            captures = detections.captures(pair)
            found = (_observe(rig, detections, pair, capture, calibration) for capture in captures)
            observations[name] = [observation for observation in found if observation is not None]
    return bring_together(observations, channel, calibration, clocks)


def _observe(
    rig: Rig, detections: Detections, pair: Pair, name: str, calibration: Calibration
) -> Observation | None:
    """Pair both sensors' detections; None if no surface in the scan is near the camera's board."""
    image, lidar = detections.of(pair, name)
    if not isinstance(image, ImageBoard) or not isinstance(lidar, list):
        return None
    candidates = CaptureCandidates(name, image, lidar)
    matched = match_candidates(candidates, rig.board.to_board(), calibration.T_cam_lidar)
    middle = calibration.T_cam_lidar @ matched.lidar.T_lidar_board[:, 3]
    apart_m = float(np.linalg.norm(middle[:3] - matched.image.T_cam_board[:3, 3]))
    return matched if apart_m < _ELSEWHERE_M else None


def _draw(
    capture: Capture,
    rig: Rig,
    check: SessionCheck,
    view: ImageWithEvents,
    seen: ImageBoard | None,
    residual: CaptureResidual | None,
    limits_m: tuple[float, float],
) -> Iterator[Overlay]:
    """Draw one capture; none if its scan cannot be read."""
    try:
        scan = capture.scan(check.pair.lidar)
    except SessionError:
        return
    name, calibration, meeting = capture.name, check.calibration, check.meetings.get(capture.name)
    warning = _warning(name, calibration)
    picture = draw_overlay(
        view.image,
        scan if meeting is None else _without(scan, meeting.measured.lidar),
        rig.cameras[calibration.camera].to_intrinsics(),
        calibration.T_cam_lidar,
        lidar_board=None if meeting is None else meeting.lidar_at_image_time,
        image_board=seen if meeting is None else meeting.measured.image,
        board=rig.board.to_board(),
        residuals=_legend(name, residual, meeting, calibration),
        title=f"{rig.name}  {check.pair}  {name}",
        limits_m=limits_m,
        warning=warning,
        events=view.events,
    )
    r = residual
    words = "" if r is None else _residual_words(r.plane_mean_m, r.edge_mean_m, r.reprojection_px)
    yield Overlay(name, picture, camera_part(picture, view.image), words, warning)


def _warning(name: str, calibration: Calibration) -> str:
    """Say why a capture was not used; empty if it was, or if the extrinsics come from another session."""
    if name in calibration.captures_used or not calibration.captures_used:
        return ""
    refusal = calibration.captures_refused.get(name)
    return "not used" if refusal is None else f"refused, {refusal.stage}: {sentence(refusal)}"


def _without(scan: Scan, lidar: LidarBoard) -> Scan:
    """Remove a board's points, which are drawn separately, moved to the image's time."""
    points, on_board = (np.ascontiguousarray(p, dtype=np.float32) for p in (scan.points, lidar.points))
    row = np.dtype((np.void, points.dtype.itemsize * 3))
    return scan.select(~np.isin(points.view(row).ravel(), on_board.view(row).ravel()))


def _legend(
    name: str, residual: CaptureResidual | None, meeting: Meeting | None, calibration: Calibration
) -> dict[str, float | str]:
    figures: dict[str, float | str] = {}
    if residual is not None:
        figures = {
            "planes (mm)": round(1000 * residual.plane_mean_m, 1),
            "edges (mm)": round(1000 * residual.edge_mean_m, 1),
            "corners (px)": round(residual.reprojection_px, 2),
        }
    if meeting is not None and meeting.way_m > 0:
        figures["moved (mm)"] = round(1000 * meeting.way_m, 1)
    refusal = calibration.captures_refused.get(name)
    if calibration.captures_used:
        is_used = name in calibration.captures_used
        figures["capture"] = "used" if is_used else f"refused, {refusal.stage}" if refusal else "not used"
    figures["sigma"] = (
        f"{calibration.sigma_rotation_deg:.2g} deg, {1000 * calibration.sigma_translation_m:.2g} mm"
    )
    figures["verdict"] = calibration.verdict
    return figures
