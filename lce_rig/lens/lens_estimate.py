"""Views of the board, and the intrinsics estimated from them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard
from lce_rig.lens.models import LensModel


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board in one image.

    Attributes:
        capture: the image's capture; views of one capture are held out together.
        channel: of the camera; each has its own noise level.
        board: its corners, and a pose to start from.
    """

    capture: str
    channel: str
    board: ImageBoard

    @property
    def name(self) -> str:
        """The view's name, such as 000012.frames."""
        return f"{self.capture}.{self.channel}"


@dataclass(frozen=True, eq=False)
class IntrinsicsEstimate:
    """Intrinsics fitted to views, with the figures to judge them.

    Attributes:
        model: of the lens.
        intrinsics: the estimate.
        cov: (P, P) of `model.parameters`, from the captures' scatter.
        cov_with_board: (P + 15, P + 15) of these and of `shape`.
        inflation: ratio of its standard deviations to those from the corners' noise alone.
        corners_board: (N, 3) estimated positions of the board's corners, which differ from the nominal ones,
            m.
        shapes: (15, N, 3) displacement of the corners per unit of `shape`.
        shape: (15,) of the board, `fit.board_shapes`: bow of the plate's middle towards the viewer along its
            width and along its height, m; fraction by which the pattern is longer along its width than along
            its height; further bends and displacements, m.
        shape_sigma: (15,) standard deviations of these.
        print_rms_m: remaining displacement of single corners, rms.
        views: used in the estimate.
        T_cam_board: (K, 4, 4) of the views.
        residuals_px: (M, 2) of `corners_px`, measured minus predicted.
        held_out_px: (K,) rms distance of each view's corners under intrinsics fitted without its capture;
            NaN without folds.
        surprise: squared distance of the estimate from the profile's intrinsics, in the standard deviations
            of these: chi-squared with about four degrees of freedom. None if they had no part in it.
        refused: name of a view -> why the estimate does not use it.
    """

    model: LensModel
    intrinsics: Intrinsics
    cov: Array
    cov_with_board: Array
    inflation: float
    corners_board: Array
    shapes: Array
    shape: Array
    shape_sigma: Array
    print_rms_m: float
    views: tuple[BoardView, ...]
    T_cam_board: Array
    residuals_px: Array
    held_out_px: Array
    surprise: float | None
    refused: Mapping[str, Refusal]

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of `model.parameters`."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    @property
    def pattern_shape(self) -> tuple[Array, Array]:
        """Bow of the pattern's middle along width and height, m, and aspect: (3,), and their deviations."""
        to_pattern = np.append(1 / 3 - self.shapes[:2, :, 2].min(axis=1), 1.0)
        return self.shape[:3] * to_pattern, self.shape_sigma[:3] * to_pattern

    @property
    def rms_px(self) -> float:
        """Rms distance of a corner from its prediction."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))

    @property
    def held_out_rms_px(self) -> float:
        """Rms distance of a corner from its prediction by intrinsics fitted to the others."""
        return float(np.sqrt(np.mean(self.held_out_px**2)))

    @property
    def corners_px(self) -> Array:
        """Corners (M, 2) of all views, without hidden ones."""
        corners_px = np.concatenate([view.board.corners_px for view in self.views])
        return np.asarray(corners_px[np.isfinite(corners_px[:, 0])])
