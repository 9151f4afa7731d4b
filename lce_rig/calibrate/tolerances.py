"""The effect of errors of lens and board, within their standard deviations.

These errors are the same in every capture: no scatter between captures shows them. Those of lens and pattern
are turned into moves of the boards' poses in the images, from which a method finds how far its result moves
(`uncertainty`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation
from lce_rig.lens.models import LensPrior
from lce_rig.rig import BoardSettings, CameraSettings

Source = Literal["intrinsics", "square_size", "pattern_offset", "plate_size", "board_bow"]

# As a fraction of a square, where a profile states none: two millimetres in a metre.
_SQUARE = 2e-3


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


class PoseErrors(NamedTuple):
    """Independent errors of lens or pattern, and what they do to the boards' poses in the images.

    Attributes:
        source: what is wrong.
        moves: (n, F, 6) tangents by which T_cam_board of each capture moves per unit of each error.
        turns: (n, 3) rotations of the camera that project like it, as the intrinsics have the same error.
    """

    source: Source
    moves: Array
    turns: Array


def pose_errors(
    observations: Sequence[Observation], board: Board, lens: SessionLens | None
) -> list[PoseErrors]:
    """List errors of lens and pattern with their effects on the poses in the images.

    Args:
        observations: F captures.
        board: as the profile says.
        lens: of the session; None leaves its errors out.
    """
    poses = np.array([observation.image.T_cam_board for observation in observations])
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    # All squares larger by a fraction: boards are as much farther away. The pattern's centre on the plate.
    farther, beside = t + R @ [*board.pattern_offset_m, 0.0], -np.moveaxis(R[:, :, :2], 2, 0)
    errors = [] if lens is None else [PoseErrors("intrinsics", lens.moves(observations), lens.turns)]
    of_pattern: dict[Source, Array] = {"square_size": farther[None], "pattern_offset": beside}
    for source, shifts in of_pattern.items():
        moves = np.concatenate([shifts, np.zeros_like(shifts)], axis=2)
        errors.append(PoseErrors(source, moves, np.zeros((len(moves), 3))))
    return errors
