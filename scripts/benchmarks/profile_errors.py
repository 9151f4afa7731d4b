"""Simulated sessions with errors of lens, board and ranges drawn from the profile's standard deviations."""

from dataclasses import replace

import numpy as np

from benchmarks.still_sessions import StillSession, draw_corners
from lce_rig.calibrate.options import Tolerances
from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.detection import Detections
from lce_rig.rig import Rig

# A separate stream of random numbers.
_STREAM = 3


def with_profile_errors(
    rig: Rig, session: StillSession, seed: int, sigma_px: float
) -> tuple[Rig, Detections, Intrinsics]:
    """Draw how wrong a profile is, and what the sensors would have seen of the same session.

    The simulated plate and LiDAR stay what they are: the profile states another plate, and points move along
    their rays by a common range offset and the plate's bow.

    Args:
        rig: that was simulated, of one camera and one LiDAR.
        session: of it.
        seed: of the errors.
        sigma_px: noise of each corner's coordinates.

    Returns:
        The profile to calibrate with, its detections, and the true lens.
    """
    rng = np.random.default_rng([seed, _STREAM])
    (camera, settings), (lidar, of_lidar) = next(iter(rig.cameras.items())), next(iter(rig.lidars.items()))
    known, board = Tolerances.of(settings, rig.board), rig.board.to_board()
    lens = _draw_lens(known, rng)
    width_m, height_m = (board.width_m, board.height_m) + known.plate_m * rng.standard_normal(2)
    corners = replace(
        board,
        square_m=board.square_m * (1 + known.square_size * float(rng.standard_normal())),
        pattern_offset_m=tuple(board.pattern_offset_m + known.pattern_offset_m * rng.standard_normal(2)),
    ).corners()
    bows_m = known.bow_m * rng.standard_normal(2)
    corners = corners + sum(bow(corners, axis, height, board) for axis, height in enumerate(bows_m))
    offset_m = of_lidar.range_offset_sigma_m * float(rng.standard_normal())
    images: dict[str, ImageBoard] = {}
    for name, T_cam_board in session.T_cam_board.items():
        image = draw_corners(rig, T_cam_board, sigma_px, rng, lens, corners)
        if image is not None:
            images[name] = image
    scans = {
        name: [_as_scanned(found, board, bows_m, offset_m) for found in places]
        for name, places in session.places.items()
        if name in images
    }
    plate = {"width_m": float(width_m), "height_m": float(height_m)}
    profile = rig.model_copy(update={"board": rig.board.model_copy(update=plate)})
    channel = next(iter(settings.channels))
    found = Detections({(camera, channel): {name: images[name] for name in scans}}, {lidar: scans})
    return profile, found, lens


def draw_session(
    rig: Rig, profile: Rig, session: StillSession, seed: int, sigma_px: float
) -> tuple[Detections, Intrinsics]:
    """Draw what the sensors of a rig see, read by another profile of it; also the true lens.

    Args:
        rig: that was simulated, of one camera and one LiDAR.
        profile: that reads the corners.
        session: of the rig.
        seed: of the noise.
        sigma_px: noise of each corner's coordinates.
    """
    rng = np.random.default_rng([seed, _STREAM])
    (camera, settings), lidar = next(iter(rig.cameras.items())), next(iter(rig.lidars))
    lens, corners = settings.to_intrinsics(), rig.board.to_board().corners()
    drawn = {
        name: draw_corners(profile, T, sigma_px, rng, lens, corners)
        for name, T in session.T_cam_board.items()
    }
    places = session.places
    images = {name: image for name, image in drawn.items() if image is not None and name in places}
    scans = {name: places[name] for name in images}
    return Detections({(camera, next(iter(settings.channels))): images}, {lidar: scans}), lens


def _draw_lens(known: Tolerances, rng: np.random.Generator) -> Intrinsics:
    prior = known.lens
    lens = prior.lens
    focal, cx_px, cy_px, radial_px, first_px, second_px = rng.standard_normal(6) * [
        prior.focal_length,
        prior.principal_point_px,
        prior.principal_point_px,
        prior.distortion_px,
        prior.decentring_px,
        prior.decentring_px,
    ]
    radius = np.hypot(lens.width_px, lens.height_px) / 2 / lens.fx_px
    k1, k2, p1, p2, *others = lens.distortion or (0.0,) * 4
    decentring_px = 3 * lens.fx_px * radius**2
    return replace(
        lens,
        fx_px=lens.fx_px * (1 + focal),
        fy_px=lens.fy_px * (1 + focal),
        cx_px=lens.cx_px + cx_px,
        cy_px=lens.cy_px + cy_px,
        distortion=(
            k1 + radial_px / (lens.fx_px * radius**3),
            k2,
            p1 + first_px / decentring_px,
            p2 + second_px / decentring_px,
            *others,
        ),
    )


def _as_scanned(lidar: LidarBoard, board: Board, bows_m: Array, offset_m: float) -> LidarBoard:
    for axis, height_m in enumerate(bows_m):
        lidar = bend(lidar, axis, float(height_m), board)
    return _lengthened(lidar, offset_m)


def _lengthened(lidar: LidarBoard, offset_m: float) -> LidarBoard:
    """Add an offset to all ranges; the plane that predicts ranges by least squares follows."""
    rays, end_rays = (
        points / np.linalg.norm(points, axis=1, keepdims=True) for points in (lidar.points, lidar.edge_points)
    )
    m = -lidar.plane[:3] / lidar.plane[3]
    jacobian = -rays / (rays @ m)[:, None] ** 2
    m = m + offset_m * symmetric_inverse(jacobian.T @ jacobian) @ jacobian.sum(axis=0)
    return replace(
        lidar,
        points=lidar.points + offset_m * rays,
        edge_points=lidar.edge_points + offset_m * end_rays,
        plane=np.append(-m, 1.0) / np.linalg.norm(m),
    )


def bow(points_board: Array, axis: int, height_m: float, board: Board) -> Array:
    """Compute shifts (M, 3) of points along the board's normal onto a parabola, highest in the middle."""
    half = (board.width_m, board.height_m)[axis] / 2
    shifts = np.zeros_like(points_board)
    shifts[:, 2] = height_m * (1 - (points_board[:, axis] / half) ** 2)
    return shifts


def bend(lidar: LidarBoard, axis: int, height_m: float, board: Board) -> LidarBoard:
    """Bend the plate that a scan shows: its points move along their rays, and the plane is fitted again.

    Args:
        lidar: a flat plate.
        axis: 0 along the width, 1 along the height.
        height_m: of the middle over the ends.
        board: the plate's size.
    """
    T_board_lidar = invert(lidar.T_lidar_board)
    normal = lidar.plane[:3]

    def onto(points: Array) -> Array:
        height = bow(transform(T_board_lidar, points), axis, height_m, board)[:, 2]
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        along = rays @ normal
        # A ray that grazes the board would move its point far along it.
        return np.asarray(points + (height / np.where(np.abs(along) < 0.2, np.inf, along))[:, None] * rays)

    points = np.asarray(lidar.points, dtype=np.float64)
    centred = points - points.mean(axis=0)
    height = bow(transform(T_board_lidar, points), axis, height_m, board)[:, 2]
    # The plane z = a + b . p fitted to the heights tilts by b and rises by a.
    inside = centred - (centred @ normal)[:, None] * normal
    slope = np.linalg.lstsq(inside, height - height.mean(), rcond=1e-6)[0]
    tilted = normal - slope
    tilted /= np.linalg.norm(tilted)
    middle = points.mean(axis=0) + height.mean() * normal
    # The fitted plane need not pass through the mean of its points.
    off = float(normal @ points.mean(axis=0) + lidar.plane[3])
    plane = np.append(tilted, -tilted @ middle + off)
    ends = np.asarray(lidar.edge_points, dtype=np.float64)
    return replace(lidar, points=onto(points), edge_points=onto(ends) if len(ends) else ends, plane=plane)
