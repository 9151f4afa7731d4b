"""The profile's limits on what a detection must show before a calibration may use it."""

from collections.abc import Sequence
from typing import Literal

from lce_rig.core.board import Board
from lce_rig.core.results import ImageBoard, LidarBoard, Refusal
from lce_rig.rig import QualitySettings


def gate_image_board(found: ImageBoard, limits: QualitySettings) -> ImageBoard | Refusal:
    """Hold a board found in a picture against the profile's limits.

    Args:
        found: with the figures of its quality record.
        limits: `quality` of the rig profile.
    """
    q = found.quality
    distance_m = q["distance_m"]
    if q["square_px"] < limits.min_square_px:
        closer_m = distance_m * (1 - q["square_px"] / limits.min_square_px)
        return Refusal(
            "image",
            f"squares of {q['square_px']:.1f} px ({limits.min_square_px:g} needed)",
            f"come {closer_m:.1f} m closer",
        )
    if q["border_px"] < limits.min_border_px:
        return Refusal(
            "image",
            f"a corner lies {q['border_px']:.1f} px from the border ({limits.min_border_px:g} needed)",
            "move the board towards the middle of the picture",
        )
    if q["tilt_deg"] > limits.max_tilt_deg:
        return Refusal(
            "image",
            f"tilted by {q['tilt_deg']:.0f} deg ({limits.max_tilt_deg:g} allowed)",
            f"turn the board {q['tilt_deg'] - limits.max_tilt_deg + 5:.0f} deg towards the camera",
        )
    return _gate_distance("image", distance_m, limits) or found


def gate_lidar_boards(
    found: Sequence[LidarBoard], board: Board, limits: QualitySettings
) -> list[LidarBoard] | Refusal:
    """Keep the candidates within the profile's limits; refuse with the likeliest one's cause where none is.

    Args:
        found: candidates, likeliest first, at least one.
        board: the size wanted.
        limits: `quality` of the rig profile.
    """
    refusals = [_lidar_problem(candidate, board, limits) for candidate in found]
    kept = [candidate for candidate, refusal in zip(found, refusals, strict=True) if refusal is None]
    return kept or refusals[0] or []


def _lidar_problem(found: LidarBoard, board: Board, limits: QualitySettings) -> Refusal | None:
    q = found.quality
    if q["n_points"] < limits.min_points:
        closer_m = max(0.1, q["distance_m"] * (1 - (q["n_points"] / limits.min_points) ** 0.5))
        return Refusal(
            "lidar",
            f"{q['n_points']:.0f} points on the board ({limits.min_points} needed)",
            f"come {closer_m:.1f} m closer",
        )
    for side, wanted_m in (("width", board.width_m), ("height", board.height_m)):
        measured_m, sigma_m = q[f"{side}_m"], q[f"{side}_sigma_m"]
        excess = abs(measured_m - wanted_m) - 3 * sigma_m - limits.max_size_error * wanted_m
        if excess > 0:
            return Refusal(
                "lidar",
                f"the plate's {side} measures {measured_m:.3f} m, the profile says {wanted_m:.3f} m",
                f"measure the plate and correct board.{side}_m, or remove what touches it",
            )
    if q["edge_rms_m"] > limits.max_edge_rms_m:
        return Refusal(
            "lidar",
            f"ring ends lie {1000 * q['edge_rms_m']:.0f} mm off a rectangle "
            f"({1000 * limits.max_edge_rms_m:.0f} allowed)",
            "keep hands and other things away from the board's border",
        )
    return _gate_distance("lidar", q["distance_m"], limits)


def _gate_distance(
    stage: Literal["image", "lidar"], distance_m: float, limits: QualitySettings
) -> Refusal | None:
    """Refuse a board that is too near or too far."""
    if distance_m < limits.min_distance_m:
        away_m = limits.min_distance_m - distance_m
        cause = f"the board is {distance_m:.2f} m away ({limits.min_distance_m:g} at least)"
        return Refusal(stage, cause, f"go {away_m + 0.05:.1f} m back")
    if distance_m > limits.max_distance_m:
        cause = f"the board is {distance_m:.2f} m away ({limits.max_distance_m:g} at most)"
        return Refusal(stage, cause, f"come {distance_m - limits.max_distance_m + 0.05:.1f} m closer")
    return None
