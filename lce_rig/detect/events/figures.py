"""Figures from events and a board tracked through their images, the profile's limits on them, and faults."""

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, difference, transform
from lce_rig.core.results import EventQuality, ImageBoard, LidarBoard
from lce_rig.detect.events.windows import hot_pixels, is_flickering
from lce_rig.detect.findings import (
    IMAGE_FEW_EVENTS,
    IMAGE_FLICKER,
    IMAGE_HARDLY_MOVED,
    IMAGE_HOT_PIXELS,
    IMAGE_NO_EVENTS,
    IMAGE_SMEARED,
    IMAGE_TOO_FAST,
    IMAGE_TURNING,
)
from lce_rig.rig import QualitySettings

#: Events older than this no longer show in the network's image.
MEMORY_NS = 1_000_000_000
_JUST_NS = 100_000_000
_BLOCK_PX = 16
# A board of 0.8 x 0.6 m takes up about this share of a DAVIS346's image at 3.5 m.
_BUSY_SHARE = 0.05
_SUBPIXEL_BITS = 4
# Poses nearer in time than this do not determine a speed.
_MIN_TRACK_S = 0.03
_ALONG = np.linspace(0, 1, 24)[:, None]


class BoardMotion(NamedTuple):
    """How the board moves about the time of its main image.

    Attributes:
        velocity_mps: (3,) of the board's middle, frame camera.
        turn_rad_s: (3,) frame camera.
        speed_sigma_mps, turn_sigma_rad_s: standard deviation of the two along themselves.
    """

    velocity_mps: Array
    turn_rad_s: Array
    speed_sigma_mps: float
    turn_sigma_rad_s: float


def outline_px(T_cam_board: Array, board: Board, intrinsics: Intrinsics) -> Array:
    """Draw the plate's outline as the lens bends it: (96, 2) px, closed, NaN if it cannot be seen."""
    corners = board.outline()
    edges = [a + _ALONG * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    pixels, _ = intrinsics.project(transform(T_cam_board, np.concatenate(edges)))
    return pixels


def event_quality(events: Events, stamp_ns: int, around_px: Array) -> EventQuality:
    """Measure how many events a board made; its motion stays unknown.

    Args:
        events: about the image.
        stamp_ns: of the image.
        around_px: (M, 2) the board's outline in it.
    """
    outline = around_px[np.isfinite(around_px).all(axis=1)]
    mask = np.zeros((events.height_px, events.width_px), dtype=np.uint8)
    if len(outline) >= 3:
        fixed = np.rint(outline * 2**_SUBPIXEL_BITS).astype(np.int32)
        cv2.fillPoly(mask, [fixed.reshape(-1, 1, 2)], 1, cv2.LINE_8, _SUBPIXEL_BITS)
    remembered = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    recent = remembered.between(stamp_ns - _JUST_NS, stamp_ns)
    # One flat index is twice as fast as two, and there are millions of events.
    n_remembered, n_recent = (
        int(np.count_nonzero(mask.ravel().take(part.y.astype(np.int32) * mask.shape[1] + part.x)))
        for part in (remembered, recent)
    )
    n_pixels = max(int(mask.sum()), 1)
    return EventQuality(n_recent / n_pixels / (1e-9 * _JUST_NS), n_remembered / n_pixels)


def busiest_events(events: Events, stamp_ns: int) -> float:
    """Count the events a pixel in the time that the network remembers, where most of them are.

    Of an image in which no board was found: blocks of pixels together as large as a board, busiest first.
    """
    recent = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    n_cols, n_rows = -(-events.width_px // _BLOCK_PX), -(-events.height_px // _BLOCK_PX)
    block = (recent.y // _BLOCK_PX).astype(np.intp) * n_cols + recent.x // _BLOCK_PX
    counts = np.sort(np.bincount(block, minlength=n_cols * n_rows))[::-1]
    busiest = counts[: max(1, round(_BUSY_SHARE * len(counts)))]
    return float(busiest.mean()) / _BLOCK_PX**2


def board_motion(found: ImageBoard) -> BoardMotion | None:
    """Fit a constant velocity to the poses of a tracked board; None if it was not tracked."""
    track_ns, track, track_cov = found.track_ns, found.track_T_cam_board, found.track_cov
    if track_ns is None or track is None or track_cov is None or found.stamp_ns is None:
        return None
    time_s = np.append(0.0, 1e-9 * (track_ns - found.stamp_ns))
    if np.ptp(time_s) < _MIN_TRACK_S:
        return None
    moved = np.concatenate([np.zeros((1, 6)), difference(track, found.T_cam_board)])
    cov = np.concatenate([found.cov[None], track_cov])
    velocity, cov_velocity = _slope(time_s, moved[:, :3], cov[:, :3, :3])
    turn, cov_turn = _slope(time_s, moved[:, 3:], cov[:, 3:, 3:])
    return BoardMotion(velocity, turn, _sigma_along(velocity, cov_velocity), _sigma_along(turn, cov_turn))


def sweep_time_s(lidar: LidarBoard, period_s: float) -> float:
    """Measure how long a LiDAR takes from its first to its last return from the board.

    Args:
        lidar: the board in one scan; without firing times the azimuth it spans tells.
        period_s: of one revolution.
    """
    if lidar.offset_ns is not None and len(lidar.offset_ns):
        return float(np.ptp(lidar.offset_ns)) * 1e-9
    azimuth = np.arctan2(lidar.points[:, 1], lidar.points[:, 0])
    middle = np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())
    span = np.ptp(np.mod(azimuth - middle + np.pi, 2 * np.pi))
    return float(span) / (2 * np.pi) * period_s


def with_motion(measured: EventQuality, found: ImageBoard, sweep_s: float | None) -> EventQuality:
    """Add figures of the board's motion; none without a track.

    Args:
        measured: figures of the board's events.
        found: with its track.
        sweep_s: how long the LiDAR sees the board; None if it does not.
    """
    motion = board_motion(found)
    if motion is None:
        return measured
    speed_mps = float(np.linalg.norm(motion.velocity_mps))
    return replace(
        measured,
        speed_mps=speed_mps,
        speed_sigma_mps=motion.speed_sigma_mps,
        turn_deg_s=float(np.degrees(np.linalg.norm(motion.turn_rad_s))),
        turn_sigma_deg_s=float(np.degrees(motion.turn_sigma_rad_s)),
        smear_m=math.nan if sweep_s is None else speed_mps * sweep_s,
    )


def _slope(time_s: Array, values: Array, cov: Array) -> tuple[Array, Array]:
    """Fit values (K, 3) = a + b t; return b (3,) and its covariance (3, 3).

    All have equal weights. With weights by covariance, in which depth and lateral position are correlated, a
    hand's lateral deviation from the line would appear as speed along the line of sight.
    """
    since_s = time_s - time_s.mean()
    share = since_s / np.sum(since_s**2)
    return share @ values, np.einsum("k,kij->ij", share**2, cov)


def _sigma_along(vector: Array, cov: Array) -> float:
    length = float(np.linalg.norm(vector))
    if length == 0:
        return float(np.sqrt(np.trace(cov)))
    return float(np.sqrt(vector @ cov @ vector)) / length


_MAX_HOT_SHARE = 0.5
# One event per hundred pixels in 1 s counts as none.
_MIN_EVENTS_PX = 0.01
# Boards at 2 to 5 cm/s make 2 to 4 events a pixel in a second: with fewer one that is missing was too slow.
_SLOW_EVENTS_PX = 4.0


def gate_event_board(found: ImageBoard, limits: QualitySettings) -> ImageBoard | Refusal:
    """Compare a board in an image from events with the profile's limits on events and motion.

    A figure that could not be measured, and images that others reconstructed, are not judged; speeds count
    if they exceed the limit by two standard deviations.

    Args:
        found: the board with figures of its events.
        limits: `quality` of the rig profile.
    """
    q = found.events
    if q is None:
        return found
    if q.events_px < limits.min_events_px:
        return IMAGE_HARDLY_MOVED.refusal(events_px=q.events_px, min_events_px=limits.min_events_px)
    # Comparisons with a figure that is not known are false.
    if q.speed_mps - 2 * q.speed_sigma_mps > limits.max_board_speed_mps:
        return too_fast(q.speed_mps, limits)
    if q.turn_deg_s - 2 * q.turn_sigma_deg_s > limits.max_turn_deg_s:
        return IMAGE_TURNING.refusal(turn_deg_s=q.turn_deg_s, max_turn_deg_s=limits.max_turn_deg_s)
    if q.smear_m > limits.max_smear_m:
        return IMAGE_SMEARED.refusal(smear_m=q.smear_m, max_smear_m=limits.max_smear_m)
    return found


def too_fast(speed_mps: float, limits: QualitySettings) -> Refusal:
    """Refuse a board that moves faster than the profile allows."""
    return IMAGE_TOO_FAST.refusal(speed_mps=speed_mps, max_speed_mps=limits.max_board_speed_mps)


def explain_missing_board(events: Events, stamp_ns: int, seen: Refusal, limits: QualitySettings) -> Refusal:
    """Return the fault of the events that prevents a detection; `seen` if there is none.

    Args:
        events: about the image.
        stamp_ns: of the image.
        seen: why there is no image, or no board in it.
        limits: `quality` of the rig profile.
    """
    if not len(events):
        return IMAGE_NO_EVENTS.refusal()
    if seen.stage == "read":
        return seen
    recent = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    n_pixels = events.width_px * events.height_px
    if len(recent) < _MIN_EVENTS_PX * n_pixels:
        return IMAGE_FEW_EVENTS.refusal(n_events=len(recent))
    if is_flickering(recent):
        return IMAGE_FLICKER.refusal()
    # Count hot pixels and measure their share of the events.
    shape = recent.height_px, recent.width_px
    index = recent.y.astype(np.intp) * recent.width_px + recent.x
    counts = np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
    is_hot = hot_pixels(np.minimum(counts, 65535).astype(np.uint16))
    n_hot, hot_share = int(is_hot.sum()), float(counts[is_hot].sum() / max(counts.sum(), 1))
    if hot_share > _MAX_HOT_SHARE:
        return IMAGE_HOT_PIXELS.refusal(n_hot=n_hot, share=hot_share)
    events_px, needed_px = busiest_events(events, stamp_ns), max(_SLOW_EVENTS_PX, limits.min_events_px)
    if events_px < needed_px:
        return IMAGE_HARDLY_MOVED.refusal(events_px=events_px, min_events_px=needed_px)
    return seen
