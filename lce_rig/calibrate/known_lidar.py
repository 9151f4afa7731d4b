"""Constant errors of a LiDAR's lasers and lens, as sessions found them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.rig import LidarIntrinsicsSettings


@dataclass(frozen=True, eq=False)
class KnownLidar:
    """Constant errors of a LiDAR, measured before.

    Attributes:
        rings: (K,) ring numbers.
        lasers: (3, K) errors of range m, azimuth rad and elevation rad, as `along_rays.ERRORS_OF_LASER`.
        lasers_sigma: (3, K) their standard deviations about what is common to all lasers.
        lens: (2,) lateral m and vertical m per rad displacement of the lens.
        lens_sigma: (2,) of it.
    """

    rings: NDArray[np.intp]
    lasers: Array
    lasers_sigma: Array
    lens: Array
    lens_sigma: Array

    @classmethod
    def of(cls, settings: LidarIntrinsicsSettings | None) -> "KnownLidar | None":
        """Read a profile's block; None if there is none."""
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
