"""What goes into a calibration: candidates per capture, the user's options, and what they are joined by."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from lce_rig.core.board import Board
from lce_rig.core.results import ImageBoard, LidarBoard, Observation
from lce_rig.extrinsics.estimate import CalibrationEstimate
from lce_rig.residuals.features import AS_FITTED, FeatureSettings
from lce_rig.rig import LidarSettings

Method = Literal["ml", "paper"]


EDGE_SHIFT_SIGMA_M = 0.015
"""How far ring ends may lie beyond an edge, a priori: beams are about as wide."""


@dataclass(frozen=True, eq=False)
class CaptureCandidates:
    """What both sensors saw of the board in one capture.

    Attributes:
        capture: its name.
        image: the board in the image, with its second pose where there is one.
        lidar: places in the scan where the board may be, best first.
    """

    capture: str
    image: ImageBoard
    lidar: Sequence[LidarBoard]


@dataclass(frozen=True)
class CalibrateOptions:
    """What a user decides about a calibration.

    Attributes:
        method: how the extrinsic is found: "paper" (Algorithm 1 of LCE-Calib) or "ml" (from Algorithm 1's
            solution on, the extrinsics, all board poses and the sensors' constant errors that are most
            probable together).
        n_draws: I, subsets drawn for each subset size; they judge the result and do not change it.
        seed: of the draws.
    """

    method: Method = "paper"
    n_draws: int = 100
    seed: int = 0


@dataclass(frozen=True)
class Algorithm1Parts:
    """Parts of Algorithm 1; benchmarks leave single ones out to see what each is good for.

    Attributes:
        features: how points and ring ends come onto the board's plane.
        n_rounds: of association and solution.
        use_uncertainty: leave out the tenth of the plane terms with the largest propagated variance.
        use_planes, use_ends: use plane terms, ring-end terms in the refinement.
        is_shift_free: ring ends may lie beyond the printed size by a common distance, as the beam's width
            makes them.
        reject_outliers: leave out captures that disagree with what the others predict.
    """

    features: FeatureSettings = AS_FITTED
    n_rounds: int = 3
    use_uncertainty: bool = True
    use_planes: bool = True
    use_ends: bool = True
    is_shift_free: bool = True
    reject_outliers: bool = True

    @property
    def edge_shift_precision(self) -> float | None:
        """Inverse variance of the edge shift a priori, 1/m^2; None if it is held at zero."""
        return 1 / EDGE_SHIFT_SIGMA_M**2 if self.is_shift_free and self.use_ends else None


@dataclass(frozen=True)
class EstimateSettings(CalibrateOptions):
    """The user's options with what the profile says of the LiDAR, and what benchmarks exchange.

    Attributes:
        laser_bias_sigma_m: standard deviation a priori of the lasers' range offsets about their mean.
        range_offset_sigma_m: standard deviation a priori of that mean, the offset common to all ranges.
        parts: of Algorithm 1.
        estimator: takes the place of the method.
    """

    laser_bias_sigma_m: float = 0.0
    range_offset_sigma_m: float = 0.0
    parts: Algorithm1Parts = Algorithm1Parts()
    estimator: "Estimator | None" = None

    @classmethod
    def of(cls, options: CalibrateOptions, lidar: LidarSettings) -> "EstimateSettings":
        """Add what the profile says of a LiDAR to a user's options."""
        settings = options if isinstance(options, cls) else cls(**vars(options))
        return replace(
            settings,
            laser_bias_sigma_m=lidar.laser_bias_sigma_m,
            range_offset_sigma_m=lidar.range_offset_sigma_m,
        )


Estimator = Callable[
    [Sequence[Observation], Board, EstimateSettings, Callable[[int, int], None] | None], CalibrationEstimate
]
"""Estimates T_cam_lidar from boards whose pairing is settled."""
