"""The effect of errors of lens and board, within their standard deviations.

These errors are the same in every capture: no scatter between captures shows them. Each is turned into what
it does to the observations, from which a method finds how far its result moves (`systematic`, `uncertainty`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, perturb, transform
from lce_rig.core.results import LidarBoard, Observation
from lce_rig.lens.models import LensPrior
from lce_rig.rig import BoardSettings, CameraSettings

Source = Literal["intrinsics", "square_size", "pattern_offset", "plate_size", "board_bow"]

# As a fraction of a square, where a profile states none: two millimetres in a metre.
_SQUARE = 2e-3
# All effects are linear; steps only keep clear of rounding.
_STEP = 1e-3


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a profile's lens and board.

    Attributes:
        lens: the intrinsics with theirs.
        square_size: relative.
        pattern_offset_m: of each coordinate of the pattern's centre on the plate.
        plate_m: of each side of the plate.
        bow_m: of the middle's height over the ends, along the width and along the height.
    """

    lens: LensPrior
    square_size: float
    pattern_offset_m: float
    plate_m: float
    bow_m: float

    @classmethod
    def of(cls, camera: CameraSettings, board: BoardSettings) -> "Tolerances":
        """Read a profile's camera and board; defaults take the place of what it leaves out."""
        squares_m = _SQUARE * board.square_m if board.square_sigma_m is None else board.square_sigma_m
        return cls(
            lens=LensPrior.read(camera, board),
            square_size=squares_m / board.square_m,
            pattern_offset_m=board.pattern_offset_sigma_m,
            plate_m=board.plate_sigma_m,
            bow_m=board.bow_sigma_m,
        )

    def sigma(self, source: Source) -> float:
        """Return the standard deviation of a source, in its own unit; errors of a lens have unit size."""
        return {
            "intrinsics": 1.0,
            "square_size": self.square_size,
            "pattern_offset": self.pattern_offset_m,
            "plate_size": self.plate_m,
            "board_bow": self.bow_m,
        }[source]


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How far an error of the profile moves the extrinsics, as they are used with the result's intrinsics.

    Or the moves that would resolve what a check contradicts: the covariance holds both sides.

    Attributes:
        source: what is wrong, or the check.
        sigma: its standard deviation, in its own unit.
        moves: (n, 6) tangents (translation m, rotation rad) per unit, of n independent errors of that size.
    """

    source: str
    sigma: float
    moves: Array

    def covariance(self) -> Array:
        """Compute the covariance (6, 6) for the source's standard deviation."""
        return np.asarray(self.sigma**2 * self.moves.T @ self.moves)


@dataclass(frozen=True, eq=False)
class Variant:
    """An error of lens or board, and what it does to the observations.

    Attributes:
        source: what is wrong.
        step: by how much, in the source's own unit.
        pose_moves: (F, 6) tangents by which it moves T_cam_board of each capture.
        board: the board that the method assumes.
        bow_axis: the axis along which the plate of the scans is bent, if it is.
        turn: (3,) rotation of the camera that projects like it, as the intrinsics have the same error.
    """

    source: Source
    step: float
    pose_moves: Array
    board: Board
    bow_axis: int | None = None
    turn: Array = field(default_factory=lambda: np.zeros(3))

    def apply(self, observations: Sequence[Observation]) -> list[Observation]:
        """Move the observations."""
        moved = []
        for o, move in zip(observations, self.pose_moves, strict=True):
            image, lidar = replace(o.image, T_cam_board=perturb(o.image.T_cam_board, move)), o.lidar
            if self.bow_axis is not None:
                lidar = bend(lidar, self.bow_axis, self.step, self.board)
            moved.append(replace(o, image=image, lidar=lidar))
        return moved


def sensitivities_of(variants: Sequence[Variant], moves: Array, known: Tolerances) -> tuple[Sensitivity, ...]:
    """Collect the moves (V, 6) of a method's result under each variant by source.

    The extrinsics are used with the intrinsics of the same result: what both errors do together counts.
    """
    by_source: dict[Source, list[Array]] = {}
    for variant, move in zip(variants, moves, strict=True):
        used = move + np.append(np.zeros(3), variant.turn)
        by_source.setdefault(variant.source, []).append(used / variant.step)
    return tuple(
        Sensitivity(source, known.sigma(source), np.array(rows)) for source, rows in by_source.items()
    )


def vary(
    observations: Sequence[Observation], board: Board, lens: SessionLens | None, *, bends_scans: bool
) -> list[Variant]:
    """List errors of lens and board with their effects on observations.

    Args:
        observations: F captures.
        board: as the profile says.
        lens: of the session; None leaves its errors out.
        bends_scans: whether the plate of the scans may be bent; not where a method estimates the bend.
    """
    poses = np.array([observation.image.T_cam_board for observation in observations])
    still = np.zeros((len(poses), 6))
    variants = []
    if lens is not None:
        moves = zip(lens.moves(observations), lens.turns, strict=True)
        variants += [Variant("intrinsics", 1.0, move, board, turn=turn) for move, turn in moves]
    # All squares larger by a fraction: boards are as much farther away. The pattern's centre on the plate.
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    middle = R @ [*board.pattern_offset_m, 0.0]
    variants.append(Variant("square_size", _STEP, _STEP * _translations(t + middle), board))
    for axis in range(2):
        variants.append(Variant("pattern_offset", _STEP, -_STEP * _translations(R[:, :, axis]), board))
    for axis in range(2 if bends_scans else 0):
        variants.append(Variant("board_bow", _STEP, still, board, axis))
    for side in ("width_m", "height_m"):
        assumed = replace(board, **{side: getattr(board, side) + _STEP})
        variants.append(Variant("plate_size", _STEP, still, assumed))
    return variants


def _translations(shifts: Array) -> Array:
    """Write shifts (F, 3) of boards as tangents (F, 6)."""
    return np.concatenate([shifts, np.zeros_like(shifts)], axis=1)


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
