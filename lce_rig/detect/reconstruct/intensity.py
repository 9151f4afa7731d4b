"""From arbitrary scales to 8 bits, without flicker: intensities of the network, sums of polarities."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lce_rig.detect.reconstruct.voxels import FloatArray

_PERCENTILES = (1.0, 99.0)
# Smallest spread that is stretched to the full range: below it there is noise, not contrast.
_MIN_SPREAD = 0.05


class GreyScale(Protocol):
    """What maps the pictures of a stream to 8 bits."""

    def follow(self, picture: FloatArray) -> None:
        """Take the next picture of the stream into account, (H, W)."""
        ...

    def to_grey(self, picture: FloatArray) -> NDArray[np.uint8]:
        """Map (H, W) to uint8."""
        ...


class SignedScale:
    """Nothing is grey 128, sums of polarities brighter and darker alike, but for the largest twentieth."""

    def follow(self, picture: FloatArray) -> None:
        """Every map stands for itself."""

    def to_grey(self, picture: FloatArray) -> NDArray[np.uint8]:
        """Map (H, W) to uint8."""
        sums = np.abs(picture[picture != 0])
        largest = float(np.percentile(sums, 95)) if len(sums) else 1.0
        return np.asarray(np.clip(np.rint(128 + 127 * picture / largest), 0, 255), dtype=np.uint8)


class IntensityScale:
    """Robust minimum and maximum, smoothed over pictures.

    Args:
        memory: weight of the past, per picture, in [0, 1).
    """

    def __init__(self, memory: float = 0.8) -> None:
        self._memory = memory
        self._smooth: NDArray[np.float64] | None = None

    def follow(self, picture: FloatArray) -> None:
        """Take the next picture of the stream into account, (H, W)."""
        bounds = _bounds(picture)
        if self._smooth is not None:
            bounds = self._memory * self._smooth + (1 - self._memory) * bounds
        self._smooth = bounds

    def to_grey(self, picture: FloatArray) -> NDArray[np.uint8]:
        """Map (H, W) to uint8."""
        bounds = _bounds(picture) if self._smooth is None else self._smooth
        spread = max(float(bounds[1] - bounds[0]), _MIN_SPREAD)
        darkest = float(bounds.mean()) - spread / 2
        scaled = (picture - darkest) * (255.0 / spread)
        return np.asarray(np.clip(np.rint(scaled), 0, 255), dtype=np.uint8)


def _bounds(picture: FloatArray) -> NDArray[np.float64]:
    # Every fourth pixel in each direction tells the percentiles well enough.
    return np.asarray(np.percentile(picture[::4, ::4], _PERCENTILES), dtype=np.float64)
