"""What intrinsics are measured from, and what comes out."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard, Refusal
from lce_rig.lens.models import LensModel


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board in one picture.

    Attributes:
        capture: what the picture belongs to; views of one capture are never held out without each other.
        channel: of the camera; each has a noise of its own.
        board: its corners, and a pose to start from.
    """

    capture: str
    channel: str
    board: ImageBoard

    @property
    def name(self) -> str:
        """What to call it: 000012.frames."""
        return f"{self.capture}.{self.channel}"


@dataclass(frozen=True, eq=False)
class IntrinsicsEstimate:
    """Intrinsics fitted to views, with everything needed to judge them.

    Attributes:
        model: of the lens.
        intrinsics: the estimate.
        cov: (P, P) of `model.parameters`, from the captures' scatter.
        inflation: how many times larger its deviations are than the corners' noise alone explains.
        corners_board: (N, 3) where the board's corners are, which is not where the drawing puts them, m.
        shape: (3,) how far the middle of the pattern stands out towards the viewer along its width and along
            its height, m; by what fraction the print is longer along its width than along its height.
        shape_sigma: (3,) standard deviations of these.
        print_rms_m: by how much single corners lie off their places beyond that, rms.
        views: behind the estimate.
        T_cam_board: (K, 4, 4) of the views.
        residuals_px: (K, N, 2) measured minus predicted.
        held_out_px: (K,) rms distance of each view's corners under a lens fitted without its capture.
        refused: name of a view -> why it is not behind the estimate.
    """

    model: LensModel
    intrinsics: Intrinsics
    cov: Array
    inflation: float
    corners_board: Array
    shape: Array
    shape_sigma: Array
    print_rms_m: float
    views: tuple[BoardView, ...]
    T_cam_board: Array
    residuals_px: Array
    held_out_px: Array
    refused: Mapping[str, Refusal]

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of `model.parameters`."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    @property
    def rms_px(self) -> float:
        """Rms distance of a corner from its prediction."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=2))))

    @property
    def held_out_rms_px(self) -> float:
        """Rms distance of a corner from its prediction by the others' lens."""
        return float(np.sqrt(np.mean(self.held_out_px**2)))

    @property
    def corners_px(self) -> Array:
        """Measured corners (K, N, 2)."""
        return np.array([view.board.corners_px for view in self.views])
