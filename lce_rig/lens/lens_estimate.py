"""Views of the board, and the intrinsics estimated from them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard
from lce_rig.lens.difference import LensCertainty
from lce_rig.lens.models import LensModel

ENOUGH_CAPTURES = 10
# The border is undetermined if a pixel's standard deviation exceeds this, and this many times that in the
# middle.
_BORDER_PX, _BORDER_RATIO = 1.0, 4.0
_BORDER_PERCENTILE = 98.0
# A focal length error of this size moves boards at 3 m by 9 mm.
_FOCAL_SIGMA = 0.003
_OVERFITTED = 1.5
_BOW_M, _ASPECT = 0.002, 0.002


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board in one image.

    Attributes:
        capture: the image's capture; views of one capture are held out together.
        channel: channel of the camera; each has its own noise level.
        board: the board's corners and initial pose.
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
        model: model of the lens.
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
        views: views used in the estimate.
        T_cam_board: (K, 4, 4) of the views.
        residuals_px: (M, 2) of `corners_px`, measured minus predicted.
        held_out_px: (K,) rms distance of each view's corners under intrinsics fitted without its capture;
            NaN without folds.
        surprise: squared distance of the estimate from the profile's intrinsics, in the standard deviations
            of these: chi-squared with about four degrees of freedom. None if they were not used.
        is_contradicted: whether the boards contradict the profile's focal lengths, principal point or
            distortion, which are therefore trusted less than the profile states.
        refused: reason why the estimate does not use a view, by its name.
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
    is_contradicted: bool
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


def find_weaknesses(estimate: IntrinsicsEstimate, certainty: LensCertainty) -> tuple[str, ...]:
    """List the weaknesses of the captures, with figures and actions, the most severe first.

    Args:
        estimate: estimate of the lens.
        certainty: uncertainty of these intrinsics.
    """
    texts, n = [], len({view.capture for view in estimate.views})
    if n < ENOUGH_CAPTURES:
        texts.append(f"only {n} captures: standard deviations are rough; collect 15 or more")
    blank = np.isnan(certainty.sigma_px)
    if blank.any():
        texts.append(
            f"the distortion folds back: {100 * blank.mean():.0f} % of the image, at its border, has no ray; "
            "place the board there too, or choose a model with fewer parameters"
        )
    inside = float(np.sqrt(np.nanmean(certainty.sigma_px[certainty.is_covered] ** 2)))
    outside = float(np.nanpercentile(certainty.sigma_px, _BORDER_PERCENTILE))
    if outside >= max(_BORDER_PX, _BORDER_RATIO * inside):
        texts.append(
            f"boards reach {100 * reach(estimate):.0f} % of the way to the image's corners (standard "
            f"deviation {outside:.1f} px beyond, {inside:.1f} px within): place boards in all four corners"
        )
    focal_sigma = float(estimate.sigma[0] / estimate.intrinsics.fx_px)
    if focal_sigma >= _FOCAL_SIGMA:
        texts.append(
            f"focal length and distance trade off (standard deviation {100 * focal_sigma:.1f} %): "
            "tilt the board by 30 to 45 deg, left and right as well as up and down, and come nearer"
        )
    if estimate.held_out_rms_px >= _OVERFITTED * estimate.rms_px:
        texts.append(
            f"held-out captures fit worse ({estimate.held_out_rms_px:.2f} px) than captures used "
            f"({estimate.rms_px:.2f} px): add captures, or choose a model with fewer parameters"
        )
    shape, shape_sigma = estimate.pattern_shape
    bow_m = max(shape[:2], key=abs)
    if abs(bow_m) > _BOW_M:
        way = "towards" if bow_m > 0 else "away from"
        texts.append(
            f"the board is bent: its middle is {1000 * abs(bow_m):.1f} mm {way} the viewer; "
            "use a stiffer plate"
        )
    aspect, sigma = float(shape[2]), float(shape_sigma[2])
    if abs(aspect) > _ASPECT + 2 * sigma:
        way = "width" if aspect > 0 else "height"
        texts.append(
            f"the pattern is {100 * abs(aspect):.2f} +- {100 * sigma:.2f} % too long along the plate's "
            f"{way}, compared with the other side: measure the squares both ways"
        )
    return tuple(texts)


def reach(estimate: IntrinsicsEstimate) -> float:
    """Return how far boards reach from the principal point to the image's farthest corner, 0..1."""
    i = estimate.intrinsics
    centre = np.array([i.cx_px, i.cy_px])
    ends = np.array([[u, v] for u in (0, i.width_px - 1) for v in (0, i.height_px - 1)])
    farthest = np.linalg.norm(ends - centre, axis=1).max()
    return float(np.linalg.norm(estimate.corners_px - centre, axis=1).max() / farthest)
