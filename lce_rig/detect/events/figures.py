"""Figures from events and a board tracked through their images: event rate, speed, smear in the LiDAR."""

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events
from lce_rig.core.geometry import Array, difference, transform
from lce_rig.core.results import EventQuality, ImageBoard, LidarBoard

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
    along_normal_mps = abs(float(motion.velocity_mps @ found.T_cam_board[:3, 2]))
    swept_s = math.nan if sweep_s is None else sweep_s
    return replace(
        measured,
        speed_mps=speed_mps,
        speed_sigma_mps=motion.speed_sigma_mps,
        turn_deg_s=float(np.degrees(np.linalg.norm(motion.turn_rad_s))),
        turn_sigma_deg_s=float(np.degrees(motion.turn_sigma_rad_s)),
        smear_m=speed_mps * swept_s,
        smear_depth_m=along_normal_mps * swept_s,
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
