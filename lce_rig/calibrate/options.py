"""Input of a calibration: candidates per capture, the user's options, and the profile's settings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.features import AS_FITTED, FeatureSettings
from lce_rig.calibrate.known_lidar import KnownLidar
from lce_rig.calibrate.tolerances import Tolerances
from lce_rig.core.board import Board
from lce_rig.core.calibration import DEFAULT_METHOD, Method
from lce_rig.core.results import ImageBoard, LidarBoard, Observation
from lce_rig.rig import LidarSettings

EDGE_SHIFT_SIGMA_M = 0.015
"""Prior standard deviation of the distance of ring ends beyond an edge: about a beam's width."""


@dataclass(frozen=True, eq=False)
class CaptureCandidates:
    """Both sensors' detections of the board in one capture.

    Attributes:
        capture: its name.
        image: the board in the image, with its second pose if there is one.
        lidar: places in the scan where the board may be, best first.
        session: where captures are of several.
    """

    capture: str
    image: ImageBoard
    lidar: Sequence[LidarBoard]
    session: str = ""


@dataclass(frozen=True)
class CalibrateOptions:
    """A user's choices for a calibration.

    Attributes:
        method: "ml" (Algorithm 1, then maximum likelihood of extrinsics, all board poses and the sensors'
            constant errors) or "paper" (Algorithm 1 of LCE-Calib alone).
        n_draws: I, subsets drawn for each subset size; they judge the result and do not change it. None for
            what the method usually draws.
        seed: of the draws.
    """

    method: Method = DEFAULT_METHOD
    n_draws: int | None = None
    seed: int = 0

    @property
    def n_drawn(self) -> int:
        """I; the paper's 100 for its own method, fewer where Algorithm 1 only gives the start."""
        usual = 100 if self.method == "paper" else 30
        return usual if self.n_draws is None else self.n_draws


@dataclass(frozen=True)
class Algorithm1Parts:
    """Parts of Algorithm 1; benchmarks switch single ones off to measure their effect.

    Attributes:
        features: how points and ring ends are projected onto the board's plane.
        n_rounds: of association and solution.
        use_uncertainty: remove the tenth of the plane terms with the largest propagated variance.
        use_planes, use_ends: use plane terms, ring-end terms in the refinement.
        is_shift_free: estimate a common distance of ring ends beyond the plate, due to the beam's width.
        reject_outliers: reject captures that disagree with the others' prediction.
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
    """The user's options, the profile's settings of the LiDAR, and parts that benchmarks replace.

    Attributes:
        laser_bias_sigma_m: standard deviation a priori of the lasers' range offsets about their mean.
        range_offset_sigma_m: standard deviation a priori of that mean, the offset common to all ranges.
        known: constant errors of the LiDAR that were measured before; None if there are none.
        tolerances: of the profile's lens and board; None does not compute their effect.
        parts: of Algorithm 1.
        estimator: replaces the method.
    """

    laser_bias_sigma_m: float = 0.0
    range_offset_sigma_m: float = 0.0
    known: KnownLidar | None = None
    tolerances: Tolerances | None = None
    parts: Algorithm1Parts = Algorithm1Parts()
    estimator: "Estimator | None" = None

    def without_constant_errors(self) -> "EstimateSettings":
        """Leave errors of the LiDAR's ranges, of lens and board out of the covariance."""
        return replace(self, laser_bias_sigma_m=0.0, range_offset_sigma_m=0.0, tolerances=None)

    @classmethod
    def of(
        cls, options: CalibrateOptions, lidar: LidarSettings, tolerances: Tolerances | None = None
    ) -> "EstimateSettings":
        """Add what the profile says of a LiDAR, and of lens and board, to a user's options."""
        settings = options if isinstance(options, cls) else cls(**vars(options))
        return replace(
            settings,
            laser_bias_sigma_m=lidar.laser_bias_sigma_m,
            range_offset_sigma_m=lidar.range_offset_sigma_m,
            known=KnownLidar.of(lidar.intrinsics),
            tolerances=tolerances,
        )


Estimator = Callable[
    [Sequence[Observation], Board, EstimateSettings, Callable[[int, int], None] | None], CalibrationEstimate
]
"""Estimates T_cam_lidar from matched boards."""
