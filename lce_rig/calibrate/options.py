"""What goes into a calibration: candidates per capture, and the switches of the algorithm."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.residuals.features import FeatureSettings

Method = Literal["ml", "paper", "zhou", "corners"]


EDGE_SHIFT_SIGMA_M = 0.015
"""How far ring ends may lie beyond an edge, a priori: beams are about as wide."""


@dataclass(frozen=True, eq=False)
class CaptureCandidates:
    """What both sensors saw of the board in one capture.

    Attributes:
        capture: its name.
        image: the board in the picture, with its second pose where there is one.
        lidar: places in the scan where the board may be, best first.
    """

    capture: str
    image: ImageBoard
    lidar: Sequence[LidarBoard]


@dataclass(frozen=True)
class CalibrateOptions:
    """Switches of the algorithm; the defaults are the recommended set.

    Attributes:
        method: how the extrinsic is found: "ml" (from Algorithm 1's solution on, the extrinsic, all board
            poses and the sensors' constant errors that are most probable together), "paper" (Algorithm 1 of
            LCE-Calib), "zhou" (lines and planes of Zhou, Li, Kaess, 2018) or "corners" (corner to corner);
            what follows matters to the first two alone.
        n_draws: I, subsets drawn for each subset size.
        n_rounds: rounds of re-association in each draw.
        seed: of the draws.
        point_projection: how points come onto the fitted plane: along their rays ("ray"), along the plane's
            normal as in the paper ("normal"), or not at all ("none").
        use_uncertainty: leave out the tenth of the plane terms with the largest propagated variance.
        use_ptpl, use_ptl: use point-to-plane, point-to-line terms in the refinement.
        plane_weight, edge_weight: weights of the two terms; where either is None, both follow from the errors
            that the captures themselves show.
        half_step: move ring ends outwards by half an azimuth step, to where the edge is expected.
        edge_shift: "free": ring ends may lie beyond the printed size by a common distance, as the finite beam
            makes them; "off": they may not.
        edge_shift_sigma_m: standard deviation of that distance a priori.
        laser_bias_sigma_m: standard deviation a priori of the lasers' range offsets about their mean.
        range_offset_sigma_m: standard deviation a priori of that mean, the offset common to all ranges.
        reject_outliers: leave out captures that disagree with what the others predict.
        min_captures: fewer captures are refused.
    """

    method: Method = "paper"
    n_draws: int = 100
    n_rounds: int = 3
    seed: int = 0
    point_projection: Literal["ray", "normal", "none"] = "ray"
    use_uncertainty: bool = True
    use_ptpl: bool = True
    use_ptl: bool = True
    plane_weight: float | None = None
    edge_weight: float | None = None
    half_step: bool = True
    edge_shift: Literal["free", "off"] = "free"
    edge_shift_sigma_m: float = EDGE_SHIFT_SIGMA_M
    laser_bias_sigma_m: float = 0.0
    range_offset_sigma_m: float = 0.0
    reject_outliers: bool = True
    min_captures: int = 3

    @property
    def features(self) -> FeatureSettings:
        """How points and ring ends come onto the board's plane."""
        return FeatureSettings(self.point_projection, self.half_step)

    @property
    def edge_shift_precision(self) -> float | None:
        """Inverse variance of the edge shift a priori, 1/m^2; None where it is held at zero."""
        is_free = self.edge_shift == "free" and self.use_ptl
        return 1 / self.edge_shift_sigma_m**2 if is_free else None
