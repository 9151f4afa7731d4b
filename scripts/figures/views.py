"""Simulated captures: how to hold the board, and examples of good and bad results."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np

import lce_rig as lce
from lce_rig.core.geometry import Array, exp_so3, invert, pose
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.rig import Rig
from lce_rig.show.overlays.overlay import draw_overlay
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.sampling import capture_at
from lce_rig.simulate.stage import Stage, set_stage

_SAME_M = 0.3
_GOOD, _BAD = "#15803d", "#b91c1c"


@dataclass(frozen=True)
class Placement:
    """A place of the board.

    Attributes:
        caption: what to learn from it.
        at: of the board's centre in the image, 0..1 from the left and from the top.
        distance_m: from the camera.
        top_deg: tilt, positive with the top towards the rig.
        left_deg: tilt, positive with the left edge towards the rig.
        roll_deg: 45 is a diamond.
    """

    caption: str
    at: tuple[float, float] = (0.5, 0.45)
    distance_m: float = 1.9
    top_deg: float = 0.0
    left_deg: float = 0.0
    roll_deg: float = 45.0


GOOD = (
    Placement("facing the rig", (0.44, 0.45)),
    Placement("top away", (0.50, 0.45), top_deg=-35.0),
    Placement("top towards the rig", (0.56, 0.42), top_deg=35.0),
    Placement("left side towards the rig", (0.3, 0.47), left_deg=35.0),
    Placement("right side towards the rig", (0.68, 0.45), left_deg=-35.0),
    Placement("far", (0.6, 0.47), 3.6, top_deg=20.0),
)
BAD = (
    Placement("cut by the image's border", (0.93, 0.45)),
    Placement("too far", (0.5, 0.5), 6.3),
    Placement("too oblique", (0.5, 0.45), left_deg=71.5),
)


def stage_of(rig: Rig, carrier: Any = "person") -> Stage:
    """Set the stage of the figures."""
    return set_stage(rig, 1, replace(SimulationOptions.for_rig(rig.name), carrier=carrier))


def draw_placements(rig: Rig, places: Sequence[Placement], columns: int = 3) -> Any:
    """Draw each placement as `verify` does, with the message if it is refused."""
    stage, finder = stage_of(rig), BoardFinder(rig)
    rows = -(-len(places) // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(3.6 * columns, 2.6 * rows), squeeze=False)
    for index, (axes, place) in enumerate(zip(grid.flat, places, strict=True)):
        capture = capture_at(stage, index, _pose(stage, place))
        seen = finder.image(capture.images[0]), finder.scan(capture.scans[0])
        refused = [each for each in seen if isinstance(each, lce.Refusal)]
        image_board = seen[0] if isinstance(seen[0], ImageBoard) else None
        lidar_board = _nearest(seen[1], capture.T_lidar_board["lidar"])
        picture = _overlay(rig, stage, capture, _truth(stage), image_board, lidar_board)
        axes.imshow(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
        axes.axis("off")
        axes.set_title(place.caption, fontsize=14, color=_BAD if refused else _GOOD, fontweight="bold")
        if refused:
            lines = (refused[0].text, refused[0].advice)
            text = "\n".join(textwrap.fill(line, 40) for line in lines)
            axes.text(0.5, -0.03, text, transform=axes.transAxes, ha="center", va="top", fontsize=10.5)
    figure.tight_layout(h_pad=1.6)
    return figure


def draw_good_and_bad(rig: Rig, degrees: float, millimetres: float) -> Any:
    """Draw one capture through the true extrinsics, and through ones that are rotated or moved."""
    stage, finder = stage_of(rig, "stand"), BoardFinder(rig)
    capture = capture_at(stage, 0, _pose(stage, Placement("", (0.55, 0.45), 2.4, top_deg=15, left_deg=20)))
    image_board = finder.image(capture.images[0])
    lidar_board = _nearest(finder.scan(capture.scans[0]), capture.T_lidar_board["lidar"])
    assert isinstance(image_board, ImageBoard) and lidar_board is not None
    truth = _truth(stage)
    turned, moved = truth.copy(), truth.copy()
    turned[:3, :3] = exp_so3(np.radians([0.0, degrees, 0.0])) @ truth[:3, :3]
    moved[:3, 3] += [0.0, millimetres / 1000, 0.0]
    cases = (
        ("good\nring ends on the outline, all sides", truth, _GOOD),
        (f"rotated by {degrees:g} deg\nall ends shifted to one side", turned, _BAD),
        (f"{millimetres:g} mm too low\ninside above, outside below", moved, _BAD),
    )
    figure, grid = plt.subplots(1, 3, figsize=(12.6, 4.8))
    for axes, (title, T_cam_lidar, colour) in zip(grid, cases, strict=True):
        picture = _overlay(rig, stage, capture, T_cam_lidar, image_board, lidar_board)
        width_px = picture.shape[1]
        scale = width_px / rig.cameras["cam"].resolution_px[0]
        u, v = scale * image_board.corners_px.mean(axis=0)
        half = 0.17 * width_px
        axes.imshow(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
        axes.set_xlim(u - half, u + half)
        axes.set_ylim(v + half, v - half)
        axes.axis("off")
        axes.set_title(title, fontsize=13, color=colour, fontweight="bold")
    figure.tight_layout()
    return figure


def _pose(stage: Stage, place: Placement) -> Array:
    view = stage.views[0]
    lens = view.intrinsics
    ray = view.T_world_cam[:3, :3] @ lens.unproject(np.array(place.at) * [lens.width_px, lens.height_px])
    right = np.cross([0.0, 0.0, 1.0], -ray)
    right /= np.linalg.norm(right)
    facing = np.stack([right, np.cross(-ray, right), -ray], axis=1)
    turns = np.radians([[place.top_deg, place.left_deg, 0.0], [0.0, 0.0, place.roll_deg]])
    tilt, roll = exp_so3(turns)
    return pose(facing @ tilt @ roll, view.T_world_cam[:3, 3] + place.distance_m * ray)


def _truth(stage: Stage) -> Array:
    view = stage.views[0]
    return np.asarray(invert(view.T_world_cam) @ view.T_world_lidar)


def _nearest(found: list[LidarBoard] | lce.Refusal, T_lidar_board: Array) -> LidarBoard | None:
    """Choose the board among the surfaces of its size."""
    if isinstance(found, lce.Refusal):
        return None

    def distance_m(board: LidarBoard) -> float:
        return float(np.linalg.norm(board.T_lidar_board[:3, 3] - T_lidar_board[:3, 3]))

    nearest = min(found, key=distance_m)
    return nearest if distance_m(nearest) < _SAME_M else None


def _overlay(
    rig: Rig,
    stage: Stage,
    capture: Any,
    T_cam_lidar: Array,
    image_board: ImageBoard | None,
    lidar_board: LidarBoard | None,
) -> Any:
    image, scan = capture.images[0], capture.scans[0]
    return draw_overlay(
        image,
        scan,
        rig.cameras[image.sensor.partition(".")[0]].to_intrinsics(),
        T_cam_lidar,
        lidar_board=lidar_board,
        image_board=image_board,
        board=stage.board,
    )
