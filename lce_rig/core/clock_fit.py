"""Clock models from readings: time requests and replies, edges timestamped by two clocks, arrivals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.clock import NS_PER_S, ClockModel
from lce_rig.core.clock_line import LineFit, median_slope
from lce_rig.core.geometry import Array

MIN_PAIRS = 4
# A timestamp in whole microseconds cannot scatter by less than this says.
RESOLUTION_NS = 1000.0
# A USB frame lasts 1 ms: what comes by USB may be as late as that every time.
ARRIVAL_BIAS_NS = 1_000_000.0

_MAX_GROUP = 5
_WANTED_GROUPS = 12
_QUICK = 0.4

Stamps = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TimePairs:
    """Times, each read on two clocks.

    Attributes:
        source_ns: (N,) reading of the clock to be modelled; rising.
        reference_ns: (N,) reading of the clock that it is modelled on.
        bound_ns: (N,) by how much the two readings may lie apart in truth; 0 where they are of one edge.
    """

    source_ns: Stamps
    reference_ns: Stamps
    bound_ns: Array

    @staticmethod
    def from_edges(source_ns: Stamps, reference_ns: Stamps) -> "TimePairs":
        """Take edges (N,) that both clocks timestamped."""
        return TimePairs(source_ns, reference_ns, np.zeros(len(source_ns)))

    @staticmethod
    def from_exchanges(
        sent_ns: Stamps, received_ns: Stamps, device_rx_ns: Stamps, device_tx_ns: Stamps
    ) -> "TimePairs":
        """Take time requests (N,) that a device answered; the device's clock is the source.

        The middle between sending and receiving is the middle between the device's own two timestamps, to
        within half of what the round trip took beyond the device's own delay, whatever the two ways had of
        it.

        Args:
            sent_ns, received_ns: when the host sent the request and had the answer.
            device_rx_ns, device_tx_ns: when the device had the request and sent the answer.

        References:
            RFC 5905, "Network Time Protocol Version 4", section 8.
        """
        round_trip_ns = (received_ns - sent_ns) - (device_tx_ns - device_rx_ns)
        return TimePairs(
            device_rx_ns + (device_tx_ns - device_rx_ns) // 2,
            sent_ns + (received_ns - sent_ns) // 2,
            np.maximum(round_trip_ns, 0) / 2,
        )

    def select(self, keep: NDArray[np.intp] | NDArray[np.bool_]) -> "TimePairs":
        """Keep the pairs of a mask or an index."""
        return TimePairs(self.source_ns[keep], self.reference_ns[keep], self.bound_ns[keep])

    def __len__(self) -> int:
        return len(self.source_ns)


def fit_clock(pairs: TimePairs, what: str, resolution_ns: float = RESOLUTION_NS) -> ClockModel | None:
    """Fit offset and drift to readings of two clocks.

    The quickest two fifths of the readings count. What one of them took beyond the very quickest,
    e_i = bound_i - min bound, put its middle wrong by up to +-e_i: by all of it where one way had it, by
    nothing where both had half. Which it was, a third unknown tells that is common to all,

        reference_i - source_i = offset + drift t_i + a e_i + noise_i,      a ~ 0 +- 1 / sqrt(3)

    or else a machine that becomes slower to answer while it is asked would pass for a drift. The quickest
    round trip itself may have been all on one way, in the same manner every time: that does not scatter, and
    is stated as bias_sigma = min bound / sqrt(3).

    Args:
        pairs: the readings.
        what: what they are, in words: "time requests".
        resolution_ns: step of the coarser clock.

    Returns:
        The model; None from fewer than 4 readings, or where all are of the same time.
    """
    if len(pairs) < MIN_PAIRS:
        return None
    n_quick = max(MIN_PAIRS, int(np.ceil(_QUICK * len(pairs))))
    quick = pairs.select(pairs.bound_ns <= np.sort(pairs.bound_ns)[n_quick - 1])
    least_ns = float(quick.bound_ns.min())
    origin = f"{len(pairs)} {what}"
    return _model(quick, quick.bound_ns - least_ns, origin, resolution_ns, least_ns / np.sqrt(3))


def fit_arrivals(
    stamp_ns: Stamps, arrival_ns: Stamps, what: str, bias_sigma_ns: float = ARRIVAL_BIAS_NS
) -> ClockModel | None:
    """Fit offset and drift of a device that cannot be asked, to when its messages arrived.

    Messages come late and never early: of every few successive ones the least late is kept. How late even
    those are, nothing tells; hence the bias.

    Args:
        stamp_ns: (N,) on the device's clock; rising.
        arrival_ns: (N,) on the host's clock.
        what: what they are, in words.
        bias_sigma_ns: how late the quickest may be.
    """
    if len(stamp_ns) < MIN_PAIRS:
        return None
    late_ns = ((arrival_ns - arrival_ns[0]) - (stamp_ns - stamp_ns[0])).astype(np.float64)
    elapsed_s = (stamp_ns - stamp_ns[0]) / NS_PER_S
    # Without its drift, the lateness of messages seconds apart can be compared.
    late_ns = late_ns - median_slope(elapsed_s, late_ns) * elapsed_s
    pairs = TimePairs.from_edges(stamp_ns, arrival_ns).select(_quickest(late_ns))
    return _model(pairs, np.zeros(len(pairs)), f"{len(stamp_ns)} {what}", RESOLUTION_NS, bias_sigma_ns)


def match_edges(
    source_ns: Stamps, reference_ns: Stamps, coarse: ClockModel, tolerance_ns: float
) -> TimePairs | None:
    """Find which edges that one clock timestamped are which of another's, by a coarse model of the two.

    Args:
        source_ns: (N,) edges on the one clock; rising.
        reference_ns: (M,) edges on the other; rising.
        coarse: from the one clock to the other, right to within the tolerance.
        tolerance_ns: how far off it may be.

    Returns:
        Edges that are nearest to each other both ways and within the tolerance; None where edges follow each
        other so closely, within twice the tolerance, that a neighbour could be taken for the right one.
    """
    if not len(source_ns) or not len(reference_ns):
        return TimePairs.from_edges(source_ns[:0], reference_ns[:0])
    if len(reference_ns) > 1 and np.median(np.diff(reference_ns)) < 2 * tolerance_ns:
        return None
    predicted_ns = coarse.convert_all(source_ns)
    nearest = _nearest(predicted_ns, reference_ns)
    is_mutual = _nearest(reference_ns, predicted_ns)[nearest] == np.arange(len(source_ns))
    is_near = np.abs(predicted_ns - reference_ns[nearest]) <= tolerance_ns
    keep = is_mutual & is_near
    return TimePairs.from_edges(source_ns[keep], reference_ns[nearest[keep]])


def _nearest(these_ns: Stamps, those_ns: Stamps) -> NDArray[np.intp]:
    """Find the index (N,) of the nearest of `those_ns` to each of `these_ns`; both rising."""
    right = np.clip(np.searchsorted(those_ns, these_ns), 1, max(len(those_ns) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(those_ns) - 1)
    return np.where(these_ns - those_ns[left] <= those_ns[right] - these_ns, left, right)


def _quickest(late: Array) -> NDArray[np.intp]:
    """Find the least late (G,) of every few successive readings (N,)."""
    size = int(np.clip(len(late) // _WANTED_GROUPS, 1, _MAX_GROUP))
    whole = len(late) // size * size
    groups = late[:whole].reshape(-1, size)
    return np.asarray(np.arange(len(groups)) * size + groups.argmin(axis=1))


def _model(
    pairs: TimePairs, excess_ns: Array, origin: str, resolution_ns: float, bias_sigma_ns: float
) -> ClockModel | None:
    """Fit a line without outliers; where there is a bias, readings were delayed and err together."""
    source_ns = pairs.source_ns
    if len(pairs) < MIN_PAIRS or source_ns.min() == source_ns.max():
        return None
    origin_ns, reference_origin_ns = int(source_ns[0]), int(pairs.reference_ns[0])
    y_ns = (pairs.reference_ns - reference_origin_ns) - (source_ns - origin_ns)
    floor_ns = resolution_ns / np.sqrt(12)
    fit = LineFit((source_ns - origin_ns) / NS_PER_S, y_ns.astype(np.float64), excess_ns, floor_ns)
    keep = fit.inliers()
    fit = fit.select(keep).centred()
    line, residual = fit.solve()
    scale = np.diag([1.0, 1.0 / NS_PER_S])
    elapsed_ns = round(fit.origin_s * NS_PER_S)
    return ClockModel(
        anchor_ns=origin_ns + elapsed_ns,
        reference_ns=reference_origin_ns + elapsed_ns + round(line[0]),
        drift=float(line[1]) / NS_PER_S,
        cov=scale @ fit.covariance(are_delayed=bias_sigma_ns > 0) @ scale,
        bias_sigma_ns=float(bias_sigma_ns),
        rms_ns=float(np.sqrt(residual @ residual / np.sum(fit.sigma_ns**-2.0))),
        first_ns=int(source_ns[keep].min()),
        last_ns=int(source_ns[keep].max()),
        n_used=int(keep.sum()),
        n_left_out=int((~keep).sum()),
        origin=origin,
    )
