"""The effect of what a profile says wrongly about lens and board, within its standard deviations.

These errors are the same in every capture: no scatter between captures shows them. Each is turned into what
it does to the observations, from which a method finds how far its result moves (`systematic`, `refine`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, perturb, skew, transform
from lce_rig.core.results import LidarBoard, Observation
from lce_rig.rig import BoardSettings, CameraSettings

Source = Literal[
    "focal_length",
    "principal_point",
    "distortion",
    "square_size",
    "pattern_offset",
    "plate_size",
    "board_bow",
]
LENS: tuple[Source, ...] = ("focal_length", "principal_point", "distortion")
"""Errors of one camera; the others are of the board, which all cameras see."""

# Where a profile states no standard deviation of a lens, in focal lengths: what calibrations of the same lens
# with a checkerboard differ by.
_FOCAL, _PRINCIPAL_POINT, _DISTORTION = 1.5e-3, 1e-3, 5e-4
# As a fraction of a square: a millimetre in a metre.
_SQUARE = 1e-3
# All effects are linear; steps only keep clear of rounding.
_STEP, _STEP_PX = 1e-3, 1.0


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a profile's lens and board.

    Attributes:
        lens: the intrinsics.
        focal_length: of both focal lengths alike, relative.
        principal_point_px: of each coordinate.
        distortion_px: of the radial displacement of a pixel in the image's corner, which grows with the third
            power of the distance from the middle.
        square_size: relative.
        pattern_offset_m: of each coordinate of the pattern's centre on the plate.
        plate_m: of each side of the plate.
        bow_m: of the middle's height over the ends, along the width and along the height.
    """

    lens: Intrinsics
    focal_length: float
    principal_point_px: float
    distortion_px: float
    square_size: float
    pattern_offset_m: float
    plate_m: float
    bow_m: float

    @classmethod
    def of(cls, camera: CameraSettings, board: BoardSettings) -> "Tolerances":
        """Read a profile's camera and board; defaults take the place of what it leaves out."""
        lens, focal_px = camera.intrinsics, camera.intrinsics.fx_px
        return cls(
            lens=camera.to_intrinsics(),
            focal_length=_FOCAL if lens.focal_sigma_px is None else lens.focal_sigma_px / focal_px,
            principal_point_px=_or(lens.principal_point_sigma_px, _PRINCIPAL_POINT * focal_px),
            distortion_px=_or(lens.distortion_sigma_px, _DISTORTION * focal_px),
            square_size=_or(board.square_sigma_m, _SQUARE * board.square_m) / board.square_m,
            pattern_offset_m=board.pattern_offset_sigma_m,
            plate_m=board.plate_sigma_m,
            bow_m=board.bow_sigma_m,
        )

    @property
    def scale(self) -> float:
        """Relative standard deviation of distances along the camera's line of sight."""
        return float(np.hypot(self.focal_length, self.square_size))

    def sigma(self, source: Source) -> float:
        """Return the standard deviation of a source, in its own unit."""
        return {
            "focal_length": self.focal_length,
            "principal_point": self.principal_point_px,
            "distortion": self.distortion_px,
            "square_size": self.square_size,
            "pattern_offset": self.pattern_offset_m,
            "plate_size": self.plate_m,
            "board_bow": self.bow_m,
        }[source]


def _or(sigma: float | None, usual: float) -> float:
    return usual if sigma is None else sigma


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How far an error of the profile moves the extrinsics.

    Attributes:
        source: what is wrong.
        sigma: its standard deviation, in its own unit.
        moves: (n, 6) tangents (translation m, rotation rad) per unit, of n independent errors of that size.
    """

    source: Source
    sigma: float
    moves: Array

    def covariance(self, sigma: float | None = None) -> Array:
        """Compute the covariance (6, 6) for the source's standard deviation, or for another one."""
        size = self.sigma if sigma is None else sigma
        return np.asarray(size**2 * self.moves.T @ self.moves)


class Variant(NamedTuple):
    """What the sensors would have seen with one error of the profile.

    Attributes:
        source: what is wrong.
        step: by how much, in the source's own unit.
        observations: one per capture.
        board: the board that the method assumes.
    """

    source: Source
    step: float
    observations: list[Observation]
    board: Board


def sensitivities_of(variants: Sequence[Variant], moves: Array, known: Tolerances) -> tuple[Sensitivity, ...]:
    """Collect the moves (V, 6) of a method's result under each variant by source."""
    by_source: dict[Source, list[Array]] = {}
    for variant, move in zip(variants, moves, strict=True):
        by_source.setdefault(variant.source, []).append(move / variant.step)
    return tuple(
        Sensitivity(source, known.sigma(source), np.array(rows)) for source, rows in by_source.items()
    )


def vary(observations: Sequence[Observation], board: Board, known: Tolerances) -> list[Variant]:
    """List what the sensors would have seen with each error of the profile.

    Args:
        observations: F captures.
        board: as the profile says.
        known: the profile's lens; errors with a standard deviation of zero are kept, as a contradiction may
            give them another.
    """
    poses = np.array([observation.image.T_cam_board for observation in observations])
    variants = []
    for source, axis, step, shifts_px, shifts_m in _image_errors(poses, board, known.lens):
        moved = perturb(poses, _pose_moves(poses, board, known.lens, shifts_px, shifts_m))
        changed = [
            replace(o, image=replace(o.image, T_cam_board=T))
            for o, T in zip(observations, moved, strict=True)
        ]
        if source == "board_bow":
            changed = [replace(o, lidar=bend(o.lidar, axis, step, board)) for o in changed]
        variants.append(Variant(source, step, changed, board))
    for side in ("width_m", "height_m"):
        assumed = replace(board, **{side: getattr(board, side) + _STEP})
        variants.append(Variant("plate_size", _STEP, list(observations), assumed))
    return variants


def _image_errors(
    poses: Array, board: Board, lens: Intrinsics
) -> Iterator[tuple[Source, int, float, Array, Array]]:
    """List the errors that move corners.

    Yields:
        Source, axis, step, shifts (F, M, 2) in px, shifts (M, 3) on the board in m.
    """
    corners = board.corners()
    by_errors = lens.differentiate_by_errors(transform(poses, corners))
    still_px, still_m = np.zeros(by_errors.shape[:-1]), np.zeros_like(corners)
    middle = np.array([*board.pattern_offset_m, 0.0])
    yield "focal_length", 0, _STEP, _STEP * by_errors[..., 0], still_m
    for axis in range(2):
        yield "principal_point", axis, _STEP_PX, _STEP_PX * by_errors[..., 1 + axis], still_m
    yield "distortion", 0, _STEP_PX, _STEP_PX * by_errors[..., 3], still_m
    yield "square_size", 0, _STEP, still_px, _STEP * (corners - middle)
    for axis in range(2):
        yield "pattern_offset", axis, _STEP, still_px, still_m + _STEP * np.eye(3)[axis]
    for axis in range(2):
        yield "board_bow", axis, _STEP, still_px, bow(corners, axis, _STEP, board)


def bow(points_board: Array, axis: int, height_m: float, board: Board) -> Array:
    """Compute shifts (M, 3) of points along the board's normal onto a parabola, highest in the middle."""
    half = (board.width_m, board.height_m)[axis] / 2
    shifts = np.zeros_like(points_board)
    shifts[:, 2] = height_m * (1 - (points_board[:, axis] / half) ** 2)
    return shifts


def _pose_moves(poses: Array, board: Board, lens: Intrinsics, shifts_px: Array, shifts_m: Array) -> Array:
    """Fit tangents (F, 6) of T_cam_board to shifts of the corners in the image and on the board.

    With J the derivative of a corner's pixel by the pose and A by its point, the pose moves by
    (sum J^T J)^-1 sum J^T (shift_px + A R shift_m).
    """
    corners = board.corners()
    R = poses[:, :3, :3]
    turned = corners @ np.swapaxes(R, 1, 2)
    by_point = lens.differentiate((turned + poses[:, None, :3, 3]).reshape(-1, 3))
    by_point = np.nan_to_num(by_point.reshape(*turned.shape[:2], 2, 3))
    J = np.concatenate([by_point, -by_point @ skew(turned)], axis=-1)
    shifts = shifts_px + (by_point @ (shifts_m @ np.swapaxes(R, 1, 2))[..., None])[..., 0]
    H = np.einsum("fmai,fmaj->fij", J, J)
    return np.asarray((symmetric_inverse(H) @ np.einsum("fmai,fma->fi", J, shifts)[..., None])[..., 0])


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
