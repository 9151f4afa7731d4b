"""Tell a mounting that changed between sessions from an estimate that errs: plates, their edges, their print.

The plates that scans show are compared with those that images show, under the first session's extrinsics
and lens by Algorithm 1. A mounting that moved displaces whole plates: upper edges out, lower edges in. Ring
ends that bleed move all edges outwards. A print that was glued elsewhere lies elsewhere within the outline
that images show.
"""

import tempfile
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

import lce_rig as lce
from benchmarks.recordings import SETS, detect
from benchmarks.tables import print_head, print_row
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.session import Session

RIG = ("rlfs01", "rlfs02", "rlfs03")
_DISTANCE_M = 2.3
# Profiles across an edge of the plate in an image, m, and the least step of grey that counts as one.
_ACROSS_M = np.arange(-0.04, 0.0405, 0.001)
_ALONG = np.linspace(0.06, 0.94, 120)
_LEAST_STEP, _NEAR_M, _LEAST = 3.0, 0.004, 25
_FAR_M = 0.04


def bench_sessions() -> None:
    """Print the sensors that moved between the recordings RLFS01 to RLFS03, by day."""
    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    edges: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    prints: dict[str, list[Array]] = defaultdict(list)
    reference = None
    with tempfile.TemporaryDirectory() as folder:
        for recorded in SETS:
            if recorded.name not in RIG:
                continue
            path = Path(folder) / recorded.name
            recorded.collect(path)
            if reference is None:
                reference = lce.calibrate_session(
                    Session.open(path), options=lce.CalibrateOptions("paper")
                ).pairs[0]
            rig, detections = detect(path)
            board, lens = rig.board.to_board(), reference.intrinsics
            assert lens is not None
            for capture, image in next(iter(detections.images.values())).items():
                places = next(iter(detections.lidars.values())).get(capture)
                if not isinstance(image, ImageBoard) or not isinstance(places, list):
                    continue
                stamp = np.datetime64(image.stamp_ns or 0, "ns").astype("datetime64[D]")
                name = recorded.name if image.stamp_ns is None else f"{recorded.name}, {stamp}"
                solved = solve_planar_pose(image.corners_px, board.corners(), lens, [image.T_cam_board])
                assert solved is not None
                T_lidar_board = invert(reference.T_cam_lidar) @ solved.T_cam_board
                lidar = min(
                    places,
                    key=lambda place: float(
                        np.linalg.norm(place.T_lidar_board[:3, 3] - T_lidar_board[:3, 3])
                    ),
                )
                off = lidar.T_lidar_board[:3, 3] - T_lidar_board[:3, 3]
                rows[name].append((float(np.linalg.norm(T_lidar_board[:3, 3])), off[2]))
                for side, outwards_m in edge_offsets(lidar, T_lidar_board, board).items():
                    edges[name][side].append(outwards_m)
                file = path / "captures" / capture / "cam.frames.png"
                picture: Array = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)  # type: ignore[assignment]
                prints[name].append(print_offset(picture, solved.T_cam_board, board, lens))
    print_head(
        "session",
        "captures",
        "plates above their images at 2.3 m, mm",
        "more per metre, mm",
        "upper edges out, mm",
        "lower edges out, mm",
        "print to the right, up on the plate, mm",
    )
    for name, points in rows.items():
        print_row(*_row(name, np.array(points), edges[name], np.array(prints[name])))


def _row(name: str, points: Array, edges: dict[str, list[float]], prints: Array) -> tuple[str, ...]:
    A = np.stack([np.ones(len(points)), points[:, 0] - _DISTANCE_M], axis=1)
    x = np.linalg.lstsq(A, points[:, 1], rcond=None)[0]
    scatter = np.std(points[:, 1] - A @ x, ddof=2)
    sigma = scatter * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    centre = np.nanmedian(prints, axis=0)
    spread = 1.48 * np.nanmedian(np.abs(prints - centre), axis=0) / np.sqrt(len(prints))
    figures = [(x[0], sigma[0]), (x[1], sigma[1])] + [
        (np.mean(edges[side]), np.std(edges[side]) / np.sqrt(len(edges[side]))) for side in ("upper", "lower")
    ]
    cells = [f"{1e3 * value:+.1f} +- {1e3 * error:.1f}" for value, error in figures]
    of_print = ", ".join(f"{1e3 * c:+.1f} +- {1e3 * s:.1f}" for c, s in zip(centre, spread, strict=True))
    return (name, str(len(points)), *cells, of_print)


def edge_offsets(lidar: LidarBoard, T_lidar_board: Array, board: Board) -> dict[str, float]:
    """Compute how far ring ends lie outside the plate's upper and lower edges in the image's pose, m."""
    ends = transform(invert(T_lidar_board), lidar.edge_points)
    points, normals = board.edges()
    outside = np.einsum("kei,ki->ke", ends[None] - points[:, None], normals)
    nearest = np.abs(outside).argmin(axis=0)
    distance = np.take_along_axis(outside, nearest[None], axis=0)[0]
    is_upper = (normals @ T_lidar_board[:3, :3].T)[nearest, 2] > 0
    is_near = np.abs(distance) < _FAR_M
    return {
        side: float(distance[is_near & chosen].mean())
        for side, chosen in (("upper", is_upper), ("lower", ~is_upper))
        if np.any(is_near & chosen)
    }


def print_offset(picture: Array, T_cam_board: Array, board: Board, lens: Intrinsics) -> Array:
    """Measure where the print lies on the plate, by the plate's edges in the image: (2,) m right and up.

    Args:
        picture: (H, W) grey values.
        T_cam_board: (4, 4) by the print's corners.
        board: the print and the plate as the profile has them.
        lens: of the picture.

    Returns:
        Relative to the profile; NaN where edges are too faint.
    """
    outline = board.outline()
    offsets = np.full(4, np.nan)
    for k, (point, normal) in enumerate(zip(*board.edges(), strict=True)):
        first, last = outline[np.abs((outline - point) @ normal) < 1e-6]
        along = first + (last - first) * _ALONG[:, None]
        across = along[:, None] + _ACROSS_M[None, :, None] * normal
        pixels = lens.project(transform(T_cam_board, across.reshape(-1, 3)))[0].reshape(*across.shape[:2], 2)
        u, v = np.moveaxis(pixels.astype(np.float32), -1, 0)
        grey = cv2.remap(picture, u, v, cv2.INTER_LINEAR)
        step = np.abs(np.gradient(cv2.GaussianBlur(grey.astype(np.float32), (5, 1), 1.0), axis=1))
        place = step[:, 3:-3].argmax(axis=1) + 3
        before, there, after = (step[np.arange(len(place)), place + d] for d in (-1, 0, 1))
        top = np.clip((before - after) / (2 * (before - 2 * there + after + 1e-9)), -1, 1)
        outside_m = _ACROSS_M[place] + 1e-3 * top
        is_sharp = there > _LEAST_STEP
        if is_sharp.sum() < _LEAST:
            continue
        is_edge = is_sharp & (np.abs(outside_m - np.median(outside_m[is_sharp])) < _NEAR_M)
        if is_edge.sum() >= _LEAST:
            offsets[k] = outside_m[is_edge].mean()
    bottom, right, top_edge, left = offsets
    return np.array([left - right, bottom - top_edge]) / 2
