"""The profile's limits on detections, and faults of events that prevent one."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Events
from lce_rig.core.findings import Refusal
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.events.figures import MEMORY_NS, busiest_events
from lce_rig.detect.events.windows import hot_pixels, is_flickering
from lce_rig.detect.findings import (
    IMAGE_FEW_EVENTS,
    IMAGE_FLICKER,
    IMAGE_HARDLY_MOVED,
    IMAGE_HOT_PIXELS,
    IMAGE_NEAR_BORDER,
    IMAGE_NO_EVENTS,
    IMAGE_SMALL_SQUARES,
    IMAGE_SMEARED,
    IMAGE_STILL_SCENE,
    IMAGE_TILTED,
    IMAGE_TOO_FAST,
    IMAGE_TURNING,
    LIDAR_OTHER_SIZE,
    LIDAR_RAGGED_EDGES,
    LIDAR_TOO_FEW_POINTS,
    TOO_NEAR_OR_FAR,
)
from lce_rig.rig import QualitySettings


def gate_image_board(sighting: ImageBoard, limits: QualitySettings) -> ImageBoard | Refusal:
    """Compare a board detected in an image with the profile's limits.

    Args:
        sighting: one without quality is judged by its pose alone.
        limits: `quality` of the rig profile.
    """
    q = sighting.quality
    if q is not None and q.square_px < limits.min_square_px:
        closer_m = sighting.distance_m * (1 - q.square_px / limits.min_square_px)
        figures = {"square_px": q.square_px, "min_square_px": limits.min_square_px, "closer_m": closer_m}
        return IMAGE_SMALL_SQUARES.refusal(**figures)
    if q is not None and q.border_px < limits.min_border_px:
        return IMAGE_NEAR_BORDER.refusal(border_px=q.border_px, min_border_px=limits.min_border_px)
    if sighting.tilt_deg > limits.max_tilt_deg:
        turn_deg = sighting.tilt_deg - limits.max_tilt_deg + 5
        figures = {"tilt_deg": sighting.tilt_deg, "max_tilt_deg": limits.max_tilt_deg, "turn_deg": turn_deg}
        return IMAGE_TILTED.refusal(**figures)
    return _gate_distance("image", sighting.distance_m, limits) or sighting


def gate_lidar_boards(
    candidates: Sequence[LidarBoard], board: Board, limits: QualitySettings
) -> list[LidarBoard] | Refusal:
    """Keep the candidates within the profile's limits; refuse with the likeliest one's cause where none is.

    Args:
        candidates: boards of the scan, likeliest first, at least one.
        board: the size wanted.
        limits: `quality` of the rig profile.
    """
    refusals = [_lidar_problem(candidate, board, limits) for candidate in candidates]
    kept = [candidate for candidate, refusal in zip(candidates, refusals, strict=True) if refusal is None]
    return kept or refusals[0] or []


def _lidar_problem(candidate: LidarBoard, board: Board, limits: QualitySettings) -> Refusal | None:
    q = candidate.quality
    if q.n_points < limits.min_points:
        closer_m = max(0.1, q.distance_m * (1 - (q.n_points / limits.min_points) ** 0.5))
        return LIDAR_TOO_FEW_POINTS.refusal(
            n_points=q.n_points, min_points=limits.min_points, closer_m=closer_m
        )
    for side, wanted_m, measured_m, sigma_m in (
        ("width", board.width_m, q.width_m, q.width_sigma_m),
        ("height", board.height_m, q.height_m, q.height_sigma_m),
    ):
        excess = abs(measured_m - wanted_m) - 3 * sigma_m - limits.max_size_error * wanted_m
        if excess > 0:
            return LIDAR_OTHER_SIZE.refusal(
                side=side, measured_m=measured_m, sigma_m=sigma_m, profile_m=wanted_m
            )
    if q.edge_rms_m > limits.max_edge_rms_m:
        return LIDAR_RAGGED_EDGES.refusal(rms_m=q.edge_rms_m, max_rms_m=limits.max_edge_rms_m)
    return _gate_distance("lidar", q.distance_m, limits)


def _gate_distance(
    stage: Literal["image", "lidar"], distance_m: float, limits: QualitySettings
) -> Refusal | None:
    """Refuse a board that is too near or too far."""
    low_m, high_m = limits.min_distance_m, limits.max_distance_m
    if distance_m < low_m:
        figures = {"distance_m": distance_m, "min_distance_m": low_m, "move_m": low_m - distance_m + 0.05}
        return TOO_NEAR_OR_FAR[stage][0].refusal(**figures)
    if distance_m > high_m:
        figures = {"distance_m": distance_m, "max_distance_m": high_m, "move_m": distance_m - high_m + 0.05}
        return TOO_NEAR_OR_FAR[stage][1].refusal(**figures)
    return None


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
        return IMAGE_STILL_SCENE.refusal(events_px=events_px, min_events_px=needed_px)
    return seen
