"""Figures of a board from events and its track, the profile's limits on them, and faults."""

import math
from dataclasses import replace

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, difference, transform
from lce_rig.core.results import EventQuality, ImageBoard, LidarBoard
from lce_rig.detect.events.windows import (
    BLOCK_PX,
    events_per_block,
    events_per_pixel,
    hot_pixels,
    is_flickering,
)
from lce_rig.detect.findings import (
    IMAGE_FEW_EVENTS,
    IMAGE_FLICKER,
    IMAGE_HARDLY_MOVED,
    IMAGE_HOT_PIXELS,
    IMAGE_TOO_FAST,
    IMAGE_TURNING,
)
from lce_rig.rig import QualitySettings

#: Age of events, ns, beyond which the network's image no longer shows them.
MEMORY_NS = 1_000_000_000
_JUST_NS = 100_000_000
# Fraction of a DAVIS346's image covered by a board of 0.8 x 0.6 m at 3.5 m.
_BUSY_SHARE = 0.05
_SUBPIXEL_BITS = 4
# Minimum interval between poses that determine a speed, s.
_MIN_TRACK_S = 0.03
_ALONG = np.linspace(0, 1, 24)[:, None]


def outline_px(T_cam_board: Array, board: Board, intrinsics: Intrinsics) -> Array:
    """Project the plate's outline: (96, 2) px, closed, with lens distortion; NaN if not visible."""
    corners = board.outline()
    edges = [a + _ALONG * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    pixels, _ = intrinsics.project(transform(T_cam_board, np.concatenate(edges)))
    return pixels


def event_quality(events: Events, stamp_ns: int, around_px: Array) -> EventQuality:
    """Compute how many events a board caused; its motion stays unknown.

    Args:
        events: events around the time of the image.
        stamp_ns: timestamp of the image.
        around_px: (M, 2) the board's outline in the image.
    """
    outline = around_px[np.isfinite(around_px).all(axis=1)]
    mask = np.zeros((events.height_px, events.width_px), dtype=np.uint8)
    if len(outline) >= 3:
        fixed = np.rint(outline * 2**_SUBPIXEL_BITS).astype(np.int32)
        cv2.fillPoly(mask, [fixed.reshape(-1, 1, 2)], 1, cv2.LINE_8, _SUBPIXEL_BITS)
    remembered = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    recent = remembered.between(stamp_ns - _JUST_NS, stamp_ns)
    # One flat index is twice as fast as two, for millions of events.
    n_remembered, n_recent = (
        int(np.count_nonzero(mask.ravel().take(part.y.astype(np.int32) * mask.shape[1] + part.x)))
        for part in (remembered, recent)
    )
    n_pixels = max(int(mask.sum()), 1)
    return EventQuality(n_recent / n_pixels / (1e-9 * _JUST_NS), n_remembered / n_pixels)


def sweep_time_s(lidar: LidarBoard, period_s: float) -> float:
    """Compute the time between a LiDAR's first and last return from the board, s.

    Args:
        lidar: the board in one scan; without firing times, its span in azimuth is used.
        period_s: duration of one revolution.
    """
    if lidar.offset_ns is not None and len(lidar.offset_ns):
        return float(np.ptp(lidar.offset_ns)) * 1e-9
    azimuth = np.arctan2(lidar.points[:, 1], lidar.points[:, 0])
    middle = np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())
    span = np.ptp(np.mod(azimuth - middle + np.pi, 2 * np.pi))
    return float(span) / (2 * np.pi) * period_s


def with_motion(measured: EventQuality, found: ImageBoard, sweep_s: float | None) -> EventQuality:
    """Add the constant velocity fitted to the poses of a tracked board; without a track, nothing changes.

    All poses have equal weights. With weights by covariance, in which depth and lateral position are
    correlated, a hand's lateral deviation from the line would appear as speed along the line of sight.

    Args:
        measured: figures of the board's events.
        found: the board, with its track.
        sweep_s: duration of the LiDAR's returns from the board; None without any.
    """
    track_ns, track, track_cov = found.track_ns, found.track_T_cam_board, found.track_cov
    if track_ns is None or track is None or track_cov is None or found.stamp_ns is None:
        return measured
    time_s = np.append(0.0, 1e-9 * (track_ns - found.stamp_ns))
    if np.ptp(time_s) < _MIN_TRACK_S:
        return measured
    since_s = time_s - time_s.mean()
    share = since_s / np.sum(since_s**2)
    # Velocity of the pose's tangent: translation in m/s, rotation in rad/s.
    velocity = share[1:] @ difference(track, found.T_cam_board)
    cov = np.einsum("k,kij->ij", share**2, np.concatenate([found.cov[None], track_cov]))
    speed_mps, speed_sigma_mps = _length(velocity[:3], cov[:3, :3])
    turn_rad_s, turn_sigma_rad_s = _length(velocity[3:], cov[3:, 3:])
    return replace(
        measured,
        speed_mps=speed_mps,
        speed_sigma_mps=speed_sigma_mps,
        turn_deg_s=float(np.degrees(turn_rad_s)),
        turn_sigma_deg_s=float(np.degrees(turn_sigma_rad_s)),
        smear_m=math.nan if sweep_s is None else speed_mps * sweep_s,
    )


def _length(vector: Array, cov: Array) -> tuple[float, float]:
    """Compute the length of a vector (3,) and its standard deviation along itself."""
    length = float(np.linalg.norm(vector))
    if length == 0:
        return 0.0, float(np.sqrt(np.trace(cov)))
    return length, float(np.sqrt(vector @ cov @ vector)) / length


#: Boards at 2 to 5 cm/s cause 2 to 4 events/px in 1 s; below, a missing board was too slow.
SLOW_EVENTS_PX = 4.0
#: Slower boards hardly make events.
MIN_SPEED_MPS = 0.03


def too_few_events(events_px: float, min_events_px: float, speed_mps: float = math.nan) -> Refusal:
    """Refuse a board with too few events; if it is known to have moved, the camera is the cause."""
    if speed_mps >= MIN_SPEED_MPS:
        return IMAGE_FEW_EVENTS.refusal(events_px=events_px, min_events_px=min_events_px, speed_mps=speed_mps)
    return IMAGE_HARDLY_MOVED.refusal(events_px=events_px, min_events_px=min_events_px)


def gate_event_board(
    found: ImageBoard, limits: QualitySettings, frame_speed_mps: float = math.nan
) -> ImageBoard | Refusal:
    """Compare a board in an image from events with the profile's limits on events and motion.

    Figures that could not be measured, and images reconstructed by other programs, are not judged. Speeds
    must exceed the limit by two standard deviations.

    Args:
        found: the board with figures of its events.
        limits: `quality` of the rig profile.
        frame_speed_mps: the board's speed in the camera's frames; NaN if unknown.
    """
    q = found.events
    if q is None:
        return found
    if q.events_px < limits.min_events_px:
        return too_few_events(q.events_px, limits.min_events_px, frame_speed_mps)
    # Comparisons with an unknown (NaN) figure are false.
    if q.speed_mps - 2 * q.speed_sigma_mps > limits.max_board_speed_mps:
        return too_fast(q.speed_mps, limits.max_board_speed_mps)
    if q.turn_deg_s - 2 * q.turn_sigma_deg_s > limits.max_turn_deg_s:
        return IMAGE_TURNING.refusal(turn_deg_s=q.turn_deg_s, max_turn_deg_s=limits.max_turn_deg_s)
    if q.smear_m > limits.max_smear_m:
        return too_fast(q.speed_mps, q.speed_mps * limits.max_smear_m / q.smear_m)
    return found


def too_fast(speed_mps: float, max_speed_mps: float) -> Refusal:
    """Refuse a board that moves faster than the profile allows."""
    return IMAGE_TOO_FAST.refusal(speed_mps=speed_mps, max_speed_mps=max_speed_mps)


def explain_missing_board(
    events: Events,
    stamp_ns: int,
    seen: Refusal,
    limits: QualitySettings,
    frame_speed_mps: float = math.nan,
) -> Refusal:
    """Return the fault of the events that prevents a detection, or else `seen`.

    Args:
        events: events around the time of the image.
        stamp_ns: timestamp of the image.
        seen: the refusal, because the image is missing or has no board in it.
        limits: `quality` of the rig profile.
        frame_speed_mps: the board's speed in the camera's frames; NaN if unknown.
    """
    if seen.stage == "read":
        return seen
    recent = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    if is_flickering(recent):
        return IMAGE_FLICKER.refusal()
    counts = events_per_pixel(recent)
    is_hot = hot_pixels(counts)
    n_hot, hot_share = int(is_hot.sum()), float(counts[is_hot].sum() / max(counts.sum(), 1))
    if hot_share > 0.5:  # most events
        return IMAGE_HOT_PIXELS.refusal(n_hot=n_hot, share=hot_share)
    # Take as many pixel blocks as a board covers, busiest first.
    of_blocks = np.sort(events_per_block(recent))[::-1]
    busiest = of_blocks[: max(1, round(_BUSY_SHARE * len(of_blocks)))]
    events_px, needed_px = float(busiest.mean()) / BLOCK_PX**2, max(SLOW_EVENTS_PX, limits.min_events_px)
    if events_px < needed_px:
        return too_few_events(events_px, needed_px, frame_speed_mps)
    return seen
