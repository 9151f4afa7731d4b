"""One LiDAR point taken into the image step by step, with all numbers, to be checked with a calculator."""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.show.report.evidence import Evidence


@dataclass(frozen=True)
class WorkedPoint:
    """A point on the board and the arithmetic that takes it to a pixel.

    Attributes:
        capture: its capture; ring: its ring.
        lines: of the arithmetic.
        pixel: (u, v) that they lead to.
        off_plane_mm: its distance from the board's plane as the camera sees it.
    """

    capture: str
    ring: int
    lines: tuple[str, ...]
    pixel: tuple[float, float]
    off_plane_mm: float


def work_point(calibration: Calibration, lens: Intrinsics, evidence: Evidence) -> WorkedPoint:
    """Choose the point nearest to the middle of the board in the capture of median range, and project it.

    The arithmetic starts from the digits that are printed.
    """
    k = int(np.argsort(evidence.range_m, kind="stable")[len(evidence.range_m) // 2])
    lidar = evidence.observations[k].lidar
    nearest = int(np.argmin(np.linalg.norm(lidar.points - lidar.T_lidar_board[:3, 3], axis=1)))
    p = np.round(lidar.points[nearest], 4)
    T = np.round(calibration.T_cam_lidar[:3], 6)
    in_camera = T[:, :3] @ p + T[:, 3]
    lines = [f"p_lidar = ({_numbers(p, 4)}) m", *map(_row, "xyz", T, [p] * 3, in_camera)]
    xy, steps = _onto_image(np.round(in_camera, 4), lens)
    u, v = lens.fx_px * xy[0] + lens.cx_px, lens.fy_px * xy[1] + lens.cy_px
    lines += steps
    lines.append(f"u = fx x' + cx = {lens.fx_px:.2f} * {_factor(xy[0], 5)} + {lens.cx_px:.2f} = {u:.1f} px")
    lines.append(f"v = fy y' + cy = {lens.fy_px:.2f} * {_factor(xy[1], 5)} + {lens.cy_px:.2f} = {v:.1f} px")
    own = np.flatnonzero(evidence.capture == k)[nearest]
    return WorkedPoint(
        evidence.observations[k].capture,
        int(lidar.ring[nearest]),
        tuple(lines),
        (float(u), float(v)),
        1000 * float(evidence.plane_m[own]),
    )


def _row(axis: str, row: Array, p: Array, value: float) -> str:
    terms = [f"{r:.6f} * {_factor(q, 4)}" for r, q in zip(row[:3], p, strict=True)]
    return f"{axis}_cam = {' + '.join([*terms, f'{row[3]:.6f}']).replace('+ -', '- ')} = {value:.4f} m"


def _factor(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if value >= 0 else f"({value:.{digits}f})"


def _numbers(values: Array, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _onto_image(p: Array, lens: Intrinsics) -> tuple[Array, list[str]]:
    """Apply the lens to a point of the camera: x', y' before the camera matrix, and the steps."""
    pixel, _ = lens.project(p)
    distorted = (pixel - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
    x, y = p[0] / p[2], p[1] / p[2]
    steps = [f"x / z = {x:.5f}, y / z = {y:.5f}"]
    if lens.model == "equidistant":
        steps.append(f"angle from the axis = atan(|(x / z, y / z)|) = {np.arctan(np.hypot(x, y)):.5f} rad")
    coefficients = ", ".join(f"{value:g}" for value in lens.distortion)
    if any(lens.distortion) or lens.model == "equidistant":
        steps.append(
            f"with the distortion ({lens.model}: {coefficients}) x' = {distorted[0]:.5f}, "
            f"y' = {distorted[1]:.5f}"
        )
    else:
        steps.append("the lens has no distortion: x' = x / z, y' = y / z")
    return distorted, steps
