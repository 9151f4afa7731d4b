"""Noise levels in the likelihood, and their priors."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from lce_rig.calibrate.algorithm_1.background import BACKGROUND_SIGMAS_M
from lce_rig.calibrate.options import EstimateSettings, KnownLidar
from lce_rig.calibrate.plane_and_ends import EDGE_SHIFT_SIGMA_M
from lce_rig.core.geometry import Array


@dataclass(frozen=True)
class Levels:
    """Standard deviations of errors that vary between measurements; estimated.

    The defaults are from recordings; `LOG_SIGMA` holds their prior standard deviations.

    Attributes:
        range_m: noise of a single range.
        ring_m: error that the returns of one ring in one capture share, beyond the laser's offset.
        edge_rad: blur of the ends of a ring end's interval, across the beam, by range (`rays`).
        backed_rad: the same with an object close behind.
        lost_share: fraction of ring ends whose last returns are missing.
        own_shift_m: each capture's own part of the edge shift.
        tilt_rad, spin_rad: errors of a board's rotation in an image beyond corner noise.
        depth_m, across_m: errors of its position, along and across the line of sight.
        laser_m: the lasers' range offsets about their mean.
    """

    range_m: float = 0.008
    ring_m: float = 0.002
    edge_rad: float = 0.0005
    backed_rad: float = 0.001
    lost_share: float = 0.08
    own_shift_m: float = 0.0005
    tilt_rad: float = 3.5e-3
    spin_rad: float = 5e-4
    depth_m: float = 0.004
    across_m: float = 0.0013
    laser_m: float = 0.008

    def blurred(self, blur_rad: float) -> "Levels":
        """Set a minimum blur of ring ends."""
        edge_rad, backed_rad = max(self.edge_rad, blur_rad), max(self.backed_rad, blur_rad)
        return replace(self, edge_rad=edge_rad, backed_rad=backed_rad)

    def ratio(self, name: str) -> float:
        """Return a level relative to its default."""
        return float(getattr(self, name) / getattr(Levels(), name))

    @property
    def largest_of_images(self) -> float:
        """Largest `ratio` of the images' levels."""
        return max(self.ratio(name) for name in OF_IMAGES)

    @property
    def of_ranges(self) -> float:
        """`ratio` of the noise of single ranges."""
        return self.ratio("range_m")

    @property
    def with_usual_images(self) -> "Levels":
        """Reset the images' levels to their defaults."""
        return replace(self, **{name: getattr(Levels(), name) for name in OF_IMAGES})


LOG_SIGMA: Mapping[str, float] = {
    **{level.name: 0.7 for level in fields(Levels)},
    **dict.fromkeys(("backed_rad", "lost_share", "own_shift_m"), 1.0),
    "laser_m": 0.3,
}
"""Prior standard deviation of the logarithm of each level; the profile gives the lasers' spread."""
# Most ring ends must be at the board's edge, or the board could not be located.
MOST_LOST = 0.6
OF_IMAGES = ("tilt_rad", "spin_rad", "depth_m", "across_m")
"""The levels of a board's pose in an image."""


EXACT = 1e-6
"""Standard deviation of an exact constant, m, rad or relative: far below any that data determine."""


@dataclass(frozen=True)
class Priors:
    """Prior standard deviations of the constant errors, which are the same in every capture.

    An estimate holds the pattern's place and the lenses, which small errors of the model would move. With
    both free, the results of two recorded sessions of one rig (rlfs01, rlfs02) differ by 7.1 mm at the
    boards, held by 4.1 mm. The covariance contains their errors.

    Attributes:
        offset_m: range offset common to all lasers.
        shift_m: edge shift d_0, `rays`.
        growth: c, its change with range; recordings show none.
        background_m: d_1, d_2 and d_3, by the background of the edge.
        plate_m: errors of the plate's width and of its height.
        displacement_m: displacement of all ring ends relative to the returns between them.
        lateral_m: lens beside the LiDAR's axis, `rays`.
        vertical_m: height of that lens, per rad of elevation.
        bow_m: height of the plate's middle over its ends, along its width and its height.
        azimuth_rad, elevation_rad: angles of each laser about their means, which are part of the extrinsics.
        stretch: relative error of ranges; held.
        contrast_m: difference of ranges between dark and white parts of the pattern; held.
        beam: relative error of the beam's width and of its height, without rings.
        known: the LiDAR's errors measured before: means and standard deviations of lasers and lens.
        squares: relative error of the squares' size.
        pattern_m: error of the pattern's place on the plate, to the right and up; held.
        optics: errors of each lens, in directions of unit variance; held.
        freedoms: degrees of freedom of Student's distribution of errors of squares, pattern and plate, as a
            profile may be grossly wrong; infinite for a normal distribution.
    """

    offset_m: float = 0.005
    shift_m: float = EDGE_SHIFT_SIGMA_M
    growth: float = 0.0001
    background_m: tuple[float, float, float] = BACKGROUND_SIGMAS_M
    plate_m: float = 0.002
    displacement_m: float = 0.00025
    lateral_m: float = 0.02
    vertical_m: float = 0.04
    bow_m: float = 0.001
    azimuth_rad: float = 4e-4
    elevation_rad: float = 2e-4
    stretch: float = EXACT
    contrast_m: float = EXACT
    beam: float = 1.0
    known: KnownLidar | None = None
    squares: float = 0.001
    pattern_m: float = 0.0001
    optics: float = 1.0
    freedoms: float = 4.0

    @property
    def of_scans(self) -> dict[str, Array]:
        """Standard deviations of the displacements of points and shifts (11,), by the names of `layout`."""
        of_width = [self.shift_m, self.growth, *self.background_m, self.plate_m, self.plate_m]
        return {
            "lens": np.array([self.lateral_m, self.vertical_m]),
            "bow": np.array([self.bow_m, self.bow_m]),
            "stretch": np.array([self.stretch]),
            "contrast": np.array([self.contrast_m]),
            "shifts": np.array([*of_width, *2 * [self.displacement_m], *2 * [self.beam]]),
        }

    @property
    def held(self) -> "Priors":
        """Fix the pattern's position and the lenses."""
        return replace(self, pattern_m=EXACT, optics=EXACT)

    @property
    def of_print(self) -> dict[str, Array]:
        """Standard deviations of squares (1,) and pattern (2,), by the names of `layout`."""
        return {"squares": np.array([self.squares]), "pattern": np.array([self.pattern_m, self.pattern_m])}


def what_is_known(options: EstimateSettings) -> tuple[Priors, Levels]:
    """Read the priors of constant errors and noise from the options."""
    offset_m = max(options.range_offset_sigma_m, EXACT)
    priors = Priors(offset_m=offset_m, shift_m=EDGE_SHIFT_SIGMA_M, known=options.known)
    if not options.has_rings:
        # Without an axis there is no lens beside it.
        priors = replace(priors, lateral_m=EXACT, vertical_m=EXACT)
    if options.tolerances is not None:
        known = options.tolerances
        priors = replace(
            priors,
            squares=max(known.square_size, EXACT),
            pattern_m=max(known.pattern_offset_m, EXACT),
            plate_m=max(known.plate_m, EXACT),
            bow_m=max(known.bow_m, EXACT),
        )
    return priors, Levels(laser_m=options.laser_bias_sigma_m)
