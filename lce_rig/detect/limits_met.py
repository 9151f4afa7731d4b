"""The profile's limits on what a detection must show before a calibration may use it."""

from collections.abc import Sequence
from typing import Literal

from lce_rig.core.board import Board
from lce_rig.core.findings import Refusal
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.findings import (
    IMAGE_NEAR_BORDER,
    IMAGE_SMALL_SQUARES,
    IMAGE_TILTED,
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
        figures = {"border_px": q.border_px, "min_border_px": limits.min_border_px}
        return IMAGE_NEAR_BORDER.refusal(**figures)
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
        figures = {"rms_m": q.edge_rms_m, "max_rms_m": limits.max_edge_rms_m}
        return LIDAR_RAGGED_EDGES.refusal(**figures)
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
