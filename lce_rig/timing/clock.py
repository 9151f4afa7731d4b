"""The relation of two clocks: offset and drift with their standard deviations, and time conversion."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

# September 2001: clocks that count from 1970 read more, those that count from their start less.
SINCE_1970_NS = 10**18
NS_PER_S = 1_000_000_000
HOUR_NS = 3600 * NS_PER_S
FOREVER_NS = 2**62
# Change of a crystal's drift as it warms up, assumed for times outside the readings.
WANDER = 1e-6


@dataclass(frozen=True, eq=False)
class ClockModel:
    """A straight line from the time of one clock, the source, to that of another, the reference.

        reference(t) = reference_ns + (1 + drift) (t - anchor_ns)                                          (1)

    Unix time in ns has more digits than a float: both ends of the line are integers.

    Attributes:
        anchor_ns: time on the source's clock, in the middle of the data.
        reference_ns: time on the reference's clock at that moment.
        drift: excess of the reference's rate over the source's, as a fraction: 40e-6 is 40 ppm.
        cov: (2, 2) of the reference's time at the anchor in ns, and of `drift` in ns per ns.
        bias_sigma_ns: error common to all readings, such as an answer always slower than its request, which
            their scatter does not contain.
        rms_ns: scatter of the readings about the line.
        first_ns, last_ns: range of the readings on the source's clock.
        n_used: readings the line was fitted to, without outliers.
        origin: the readings in words: "98 time requests".
    """

    anchor_ns: int
    reference_ns: int
    drift: float
    cov: Array
    bias_sigma_ns: float
    rms_ns: float
    first_ns: int
    last_ns: int
    n_used: int
    origin: str

    @staticmethod
    def identity(sigma_ns: float, origin: str) -> "ClockModel":
        """Build the model of a clock that already shows the reference's time.

        Args:
            sigma_ns: standard deviation of that time.
            origin: the reason, in words: "PPS locked".
        """
        return ClockModel(0, 0, 0.0, np.zeros((2, 2)), sigma_ns, 0.0, -FOREVER_NS, FOREVER_NS, 0, origin)

    def convert(self, source_ns: int) -> int:
        """Convert a time of the source's clock to the reference's (1)."""
        elapsed_ns = source_ns - self.anchor_ns
        return self.reference_ns + elapsed_ns + round(self.drift * elapsed_ns)

    def convert_all(self, source_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert times (N,) of the source's clock to the reference's (1)."""
        elapsed_ns = np.asarray(source_ns, dtype=np.int64) - self.anchor_ns
        drifted_ns = np.rint(self.drift * elapsed_ns).astype(np.int64)
        return np.asarray(self.reference_ns + elapsed_ns + drifted_ns)

    def sigma_ns(self, source_ns: int) -> float:
        """Return the standard deviation of `convert`.

            sigma(t)^2 = c00 + 2 c01 dt + c11 dt^2 + bias^2 + (WANDER outside)^2

        with dt from the anchor, and `outside` the time by which t lies before or after the data.
        """
        elapsed_ns = float(source_ns - self.anchor_ns)
        outside_ns = max(self.first_ns - source_ns, source_ns - self.last_ns, 0)
        line = self.cov[0, 0] + 2 * self.cov[0, 1] * elapsed_ns + self.cov[1, 1] * elapsed_ns**2
        return float(np.sqrt(line + self.bias_sigma_ns**2 + (WANDER * outside_ns) ** 2))

    def inverse(self) -> "ClockModel":
        """Build the model that reads the source's clock on the reference's."""
        return replace(  # the covariance is the same to first order in the drift
            self,
            anchor_ns=self.reference_ns,
            reference_ns=self.anchor_ns,
            drift=-self.drift / (1 + self.drift),
            first_ns=self.convert(self.first_ns),
            last_ns=self.convert(self.last_ns),
        )

    def then(self, other: "ClockModel") -> "ClockModel":
        """Build the model from this source to another's reference, by way of the clock that both share.

        Args:
            other: its source is this model's reference; its errors are independent of this one's.
        """
        elapsed_ns = float(self.reference_ns - other.anchor_ns)
        shift = np.array([[1.0, elapsed_ns], [0.0, 1.0]])
        back = self.inverse()
        return ClockModel(
            self.anchor_ns,
            other.convert(self.reference_ns),
            (1 + self.drift) * (1 + other.drift) - 1,
            self.cov + shift @ other.cov @ shift.T,
            float(np.hypot(self.bias_sigma_ns, other.bias_sigma_ns)),
            float(np.hypot(self.rms_ns, other.rms_ns)),
            max(self.first_ns, back.convert(other.first_ns)),
            min(self.last_ns, back.convert(other.last_ns)),
            min(self.n_used, other.n_used),
            f"{self.origin}, then {other.origin}",
        )


def resolve_hour(past_hour_ns: int, near_ns: int) -> int:
    """Complete a time that is known only within the hour.

    Args:
        past_hour_ns: time since the full hour; may exceed an hour where a counter has not wrapped yet.
        near_ns: about the same time on a clock with the hour, accurate to half an hour.

    Returns:
        The time that is `past_hour_ns` past some hour, and nearest to `near_ns`.
    """
    return past_hour_ns + HOUR_NS * ((near_ns - past_hour_ns + HOUR_NS // 2) // HOUR_NS)
