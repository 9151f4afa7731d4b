"""Options of a calibration, and the profile's settings of the LiDAR, the lens and the board."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.calibration import DEFAULT_METHOD, Method
from lce_rig.core.geometry import Array
from lce_rig.lens.models import LensPrior
from lce_rig.rig import BoardSettings, CameraSettings, LidarIntrinsicsSettings, LidarSettings

# Default standard deviation of a square's side, as a fraction: two millimetres per metre.
_SQUARE = 2e-3


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a profile's lens and board.

    Attributes:
        lens: intrinsics with their standard deviations.
        square_size: relative standard deviation of a square's side.
        pattern_offset_m: standard deviation of each coordinate of the pattern's centre on the plate.
        plate_m: standard deviation of each side of the plate.
        bow_m: standard deviation of the middle's height over the ends, along the width and along the height.
    """

    lens: LensPrior
    square_size: float
    pattern_offset_m: float
    plate_m: float
    bow_m: float

    @classmethod
    def of(cls, camera: CameraSettings, board: BoardSettings) -> "Tolerances":
        """Read a profile's camera and board; missing settings get defaults."""
        squares_m = _SQUARE * board.square_m if board.square_sigma_m is None else board.square_sigma_m
        return cls(
            lens=LensPrior.read(camera, board),
            square_size=squares_m / board.square_m,
            pattern_offset_m=board.pattern_offset_sigma_m,
            plate_m=board.plate_sigma_m,
            bow_m=board.bow_sigma_m,
        )


@dataclass(frozen=True)
class CalibrateOptions:
    """A user's choices for a calibration.

    Attributes:
        method: "ml" (Algorithm 1, then maximum likelihood of extrinsics, all board poses and the sensors'
            constant errors) or "paper" (Algorithm 1 of LCE-Calib alone).
    """

    method: Method = DEFAULT_METHOD


@dataclass(frozen=True, eq=False)
class KnownLidar:
    """Constant errors of a LiDAR, measured earlier.

    Attributes:
        rings: (K,) ring numbers.
        lasers: (3, K) errors of range m, azimuth rad and elevation rad, as `likelihood.layout.LASER`.
        lasers_sigma: (3, K) their standard deviations about the mean of all lasers.
        lens: (2,) lateral m and vertical m per rad displacement of the lens.
        lens_sigma: (2,) its standard deviations.
    """

    rings: NDArray[np.intp]
    lasers: Array
    lasers_sigma: Array
    lens: Array
    lens_sigma: Array

    @classmethod
    def of(cls, settings: LidarIntrinsicsSettings | None) -> "KnownLidar | None":
        """Read a profile's block; None if it is missing."""
        if settings is None:
            return None
        lasers = settings.lasers
        values = [[e.range_m, np.radians(e.azimuth_deg), np.radians(e.elevation_deg)] for e in lasers]
        sigmas = [
            [e.range_sigma_m, np.radians(e.azimuth_sigma_deg), np.radians(e.elevation_sigma_deg)]
            for e in lasers
        ]
        return cls(
            np.array([e.ring for e in lasers], dtype=np.intp),
            np.array(values).T,
            np.array(sigmas).T,
            np.array([settings.lens_lateral_m, settings.lens_vertical_m_per_rad]),
            np.array([settings.lens_lateral_sigma_m, settings.lens_vertical_sigma_m_per_rad]),
        )


@dataclass(frozen=True)
class EstimateSettings(CalibrateOptions):
    """The user's options and the profile's settings of the LiDAR.

    Attributes:
        laser_bias_sigma_m: standard deviation a priori of the lasers' range offsets about their mean.
        range_offset_sigma_m: standard deviation a priori of that mean, the offset common to all ranges.
        has_rings: whether the LiDAR scans in rings.
        known: constant errors of the LiDAR that were measured before; None if there are none.
        tolerances: tolerances of the profile's lens and board; None treats both as exact.
        lens: the session's lens; None to fit it first, with tolerances.
    """

    laser_bias_sigma_m: float = 0.0
    range_offset_sigma_m: float = 0.0
    has_rings: bool = True
    known: KnownLidar | None = None
    tolerances: Tolerances | None = None
    lens: SessionLens | None = None

    @classmethod
    def of(
        cls, options: CalibrateOptions, lidar: LidarSettings, tolerances: Tolerances | None = None
    ) -> "EstimateSettings":
        """Combine a user's options with the profile's settings of a LiDAR, lens and board."""
        return cls(
            options.method,
            laser_bias_sigma_m=lidar.laser_bias_sigma_m,
            range_offset_sigma_m=lidar.range_offset_sigma_m,
            has_rings=lidar.has_rings,
            known=KnownLidar.of(lidar.intrinsics),
            tolerances=tolerances,
        )
