"""The session's lens: the profile's intrinsics and the boards in the images, weighted by information.

The LiDAR is not used. Its constant errors, a rotation about the vertical of 0.1 to 0.2 deg in recordings,
look like a shift of the principal point and would bias the lens. Lens and shape of the board
therefore follow from the images and the profile alone; every pose of the board is refitted with them, and
the extrinsics are estimated with these poses. The covariance of lens and board is propagated to first order:

    cov = cov_T|K + J cov_K J^T,    cov_K' = J cov_K,    J = dT / dK + W                                   (1)

Extrinsics and intrinsics of a result are used together. An error of the intrinsics that projects like a
rotation W of the camera rotates the extrinsics back by nearly as much; W in J keeps the difference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lce_rig.calibrate.observations import group_poses
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, difference, perturb
from lce_rig.core.results import ImageBoard, Observation
from lce_rig.lens.calibrate_lens import estimate_intrinsics
from lce_rig.lens.difference import turn_of_lens
from lce_rig.lens.fit import fit_poses, pose_moves
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate
from lce_rig.lens.models import LensPrior, model_of

# Maximum number of images: more hardly improve a lens and take time.
_MAX_VIEWS = 80
# Typical noise of a pose, m and rad; errors below this fraction of it, over all images, are negligible.
_NOISE = np.repeat([1e-3, 5e-4], 3)
_NEGLIGIBLE = 0.1


@dataclass(frozen=True, eq=False)
class SessionLens:
    """A camera's intrinsics and the board's shape, from the profile and the session's images.

    Attributes:
        estimate: estimate of both.
        prior: the profile's.
    """

    estimate: IntrinsicsEstimate
    prior: LensPrior

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's."""
        return self.estimate.intrinsics

    @property
    def focal_sigma(self) -> float:
        """Relative standard deviation of the focal length."""
        return float(self.estimate.sigma[0] / self.intrinsics.fx_px)

    @cached_property
    def directions(self) -> Array:
        """Independent errors (n, P + 15) of lens and board, of one standard deviation each."""
        cov = self.estimate.cov_with_board
        sigma = np.sqrt(np.diag(cov))
        variances, axes = np.linalg.eigh(cov / np.outer(sigma, sigma))
        return np.asarray((np.sqrt(np.maximum(variances, 0.0)) * axes).T * sigma)

    def errors(self, images: Sequence[ImageBoard]) -> tuple[Array, Array, Array]:
        """List independent errors of lens and board, of unit variance, that matter in F images.

        Errors that move the poses of all images together by a fraction of their noise are omitted.

        Returns:
            (F, 6, n) tangents by which each moves the fitted poses, (n, P) by which it moves the intrinsics,
            and (3, n) rotations of the camera that project like it.
        """
        corners_px = np.array([image.corners_px for image in images])
        poses = np.array([image.T_cam_board for image in images])
        moves = pose_moves(self.estimate, corners_px, poses, self.directions)
        by_lens = turn_of_lens(self.intrinsics)
        P = by_lens.shape[1]
        effects = (moves / _NOISE).reshape(len(moves), -1)
        effects = np.hstack([effects, self.directions[:, :P] @ by_lens.T / _NOISE[3:]])
        axes, sizes, _ = np.linalg.svd(effects, full_matrices=False)
        axes = axes[:, sizes > _NEGLIGIBLE].T
        of_lens = axes @ self.directions[:, :P]
        return np.moveaxis(np.tensordot(axes, moves, axes=1), 0, -1), of_lens, by_lens @ of_lens.T

    def refit(self, observations: Sequence[Observation]) -> list[Observation]:
        """Refit the board poses in the images of observations with this lens and board."""
        images = self.refit_images([each.image for each in observations])
        return [replace(each, pose=image) for each, image in zip(observations, images, strict=True)]

    def refit_images(self, boards: Sequence[ImageBoard]) -> list[ImageBoard]:
        """Refit the poses of boards with this lens and board."""
        corners_px = np.array([board.corners_px for board in boards])
        F, n = len(boards), np.isfinite(corners_px[..., 0]).sum(axis=1)
        has_other = np.array([board.T_cam_board_alternative is not None for board in boards])
        starts = [board.T_cam_board for board in boards]
        for board in boards:
            other = board.T_cam_board_alternative
            starts.append(board.T_cam_board if other is None else other)
        fitted = fit_poses(self.estimate, np.concatenate([corners_px, corners_px]), np.array(starts))
        # Sort the two minima of each board by cost.
        order = np.argsort(fitted[1].reshape(2, F), axis=0, kind="stable")
        (T, T_other), (cost, cost_other), (H, _) = (
            values.reshape(2, F, *values.shape[1:])[order, np.arange(F)] for values in fitted
        )
        variance = np.maximum(cost / np.maximum(2 * n - 6, 1), 1e-12)
        gap = np.where(has_other, (cost_other - cost) / variance, np.inf)
        cov = variance[:, None, None] * np.linalg.inv(H)
        # Shift the poses in the images shortly before and after by the same tangent.
        moved = difference(T, np.array([board.T_cam_board for board in boards]))
        tracks = [
            None if board.track_T_cam_board is None else perturb(board.track_T_cam_board, tangent)
            for board, tangent in zip(boards, moved, strict=True)
        ]
        return [
            replace(
                board,
                T_cam_board=T[k],
                track_T_cam_board=tracks[k],
                cov=cov[k],
                T_cam_board_alternative=T_other[k] if has_other[k] else None,
                chi2_gap=float(gap[k]),
                reprojection_px=float(np.sqrt(cost[k] / n[k])),
                sigma_px=float(np.sqrt(variance[k])),
            )
            for k, board in enumerate(boards)
        ]


def fit_session_lens(
    images: Mapping[str, Sequence[ImageBoard]], board: Board, prior: LensPrior
) -> SessionLens:
    """Fit the lens that all channels of a camera share, and the board's shape.

    Args:
        images: boards in the images of all captures, by channel.
        board: the board's specification.
        prior: the profile's intrinsics.

    Raises:
        NotEnoughDataError: no channel has a board, or boards and profile leave the intrinsics undetermined.
    """
    every = [(channel, image) for channel, of_channel in images.items() for image in of_channel]
    thinned = every[:: max(1, -(-len(every) // _MAX_VIEWS))]
    placement = group_poses(np.array([image.T_cam_board for _, image in thinned]).reshape(-1, 4, 4))
    # Images of one placement share their errors.
    views = [
        BoardView(f"{number:06d}", channel, image)
        for number, (channel, image) in zip(placement.tolist(), thinned, strict=True)
    ]
    estimate = estimate_intrinsics(views, board, prior.lens, model_of(prior.lens), prior=prior, n_folds=0)
    return SessionLens(estimate, prior)
