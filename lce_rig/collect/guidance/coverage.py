"""How much of what is reachable the captures have shown: bars that fill up."""

from dataclasses import dataclass

import numpy as np

from lce_rig.collect.guidance.candidates import DIAMOND_DEG, SensorPlace
from lce_rig.collect.guidance.instructions import describe_pose
from lce_rig.core.geometry import Array

#: A bar is full where captures span this share of what reachable placements span.
FULL_SHARE = 0.7
#: The board leans to a side from here on.
LEANS_DEG = 15.0
#: Boards turned in their plane by so much, least against most.
FULL_ROLL_DEG = 20.0


@dataclass(frozen=True)
class Coverage:
    """Five bars, each 0..1.

    Attributes:
        left_right, up_down: how far apart in the image boards were.
        near_far: how much farther the farthest was than the nearest.
        tilt: a quarter for each of top, bottom, left and right that was towards the rig by `LEANS_DEG`.
        roll: how differently boards were turned in their plane.
    """

    left_right: float
    up_down: float
    near_far: float
    tilt: float
    roll: float


def measure_coverage(view: SensorPlace, held: Array, reachable: Array) -> Coverage:
    """Measure the coverage of captures.

    Args:
        view: the sensors.
        held: (N, 4, 4) T_cam_board of the captures.
        reachable: (M, 4, 4) T_cam_board that could be, `Planner.candidates`.
    """
    if len(held) == 0:
        return Coverage(0.0, 0.0, 0.0, 0.0, 0.0)
    shown, whole = _places(view, held), _places(view, reachable)
    spans = np.ptp(shown, axis=0) / np.maximum(FULL_SHARE * np.ptp(whole, axis=0), 1e-9)
    left_right, up_down, near_far = np.clip(spans, 0.0, 1.0)
    poses = [describe_pose(view, T_cam_board) for T_cam_board in held]
    lean = np.array([[pose.tilt_deg, pose.turn_deg] for pose in poses])
    leanings = np.concatenate([lean.max(axis=0) > LEANS_DEG, lean.min(axis=0) < -LEANS_DEG])
    # A pattern looks the same from either end.
    roll = np.array([(pose.roll_deg - DIAMOND_DEG + 90) % 180 - 90 for pose in poses])
    return Coverage(
        left_right=float(left_right),
        up_down=float(up_down),
        near_far=float(near_far),
        tilt=float(leanings.mean()),
        roll=float(min(np.ptp(roll) / FULL_ROLL_DEG, 1.0)),
    )


def _places(view: SensorPlace, T_cam_board: Array) -> Array:
    """Where board centres lie in the image, px, and how far away they are, as a logarithm, (N, 3)."""
    centre = T_cam_board[:, :3, 3]
    pixels, _ = view.model.lens.project(centre)
    # A centre out of sight counts as one at the image's middle.
    middle = [view.model.lens.cx_px, view.model.lens.cy_px]
    pixels = np.where(np.isfinite(pixels), pixels, middle)
    return np.column_stack([pixels, np.log(np.linalg.norm(centre, axis=1))])
