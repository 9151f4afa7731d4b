"""Clock models from readings: time requests and replies, and edges timestamped by two clocks.

`ClockTracker` keeps the model of a running clock's last minute, and reports when one of the clocks jumps.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import SIGMA_PER_MAD, Array
from lce_rig.timing.clock import NS_PER_S, ClockModel

MIN_PAIRS = 4
# Minimum scatter of a timestamp in whole microseconds.
_FLOOR_NS = 1000.0 / np.sqrt(12)
_N_ROUNDS = 10
_N_STRETCHES = 8
_MIN_INLIERS = 3
_MAX_PAIRS = 2048
_N_WITNESSES = 3
# Minimum step that counts as a jump, in standard deviations of the readings and, for exact ones, in ns.
_STEP_SIGMAS, _MIN_STEP_NS = 8.0, 200_000.0
# Length of the fitted window: drift changes with temperature, so older readings are dropped.
_WINDOW_NS = 60 * NS_PER_S

Stamps = NDArray[np.int64]


def fit_clock(
    source_ns: Stamps, reference_ns: Stamps, what: str, bound_ns: Array | None = None
) -> ClockModel | None:
    """Fit offset and drift to readings of two clocks, without outliers.

    Only the quickest two fifths of the readings are used. The delay of a reading beyond the quickest one, e_i
    = bound_i - min bound, shifts its middle by up to +-e_i: fully if the whole delay was in one direction,
    not at all if both directions shared it equally. The asymmetry a is a third unknown, common to all
    readings:

        reference_i - source_i = offset + drift t_i + a e_i + noise_i,      a ~ 0 +- 1 / sqrt(3)

    Without it, answers that become slower would look like a drift. The quickest round trip may be asymmetric
    too, in the same way every time. Such an error does not scatter; it is reported as
    bias_sigma = min bound / sqrt(3).

    Args:
        source_ns: (N,) readings of the clock to be modelled; rising.
        reference_ns: (N,) readings of the reference clock.
        what: the readings in words: "time requests".
        bound_ns: (N,) bound on the time between both readings of a pair; None if they are of one edge.

    Returns:
        The model; None with fewer than 4 readings, or if all are of the same time.
    """
    n_readings = len(source_ns)
    if n_readings < MIN_PAIRS:
        return None
    bound_ns = np.zeros(n_readings) if bound_ns is None else bound_ns
    n_quick = max(MIN_PAIRS, int(np.ceil(0.4 * n_readings)))
    is_quick = bound_ns <= np.sort(bound_ns)[n_quick - 1]
    source_ns, reference_ns, bound_ns = source_ns[is_quick], reference_ns[is_quick], bound_ns[is_quick]
    least_ns = float(bound_ns.min())
    if source_ns.min() == source_ns.max():
        return None
    origin_ns, reference_origin_ns = int(source_ns[0]), int(reference_ns[0])
    y_ns = ((reference_ns - reference_origin_ns) - (source_ns - origin_ns)).astype(np.float64)
    fit = LineFit((source_ns - origin_ns) / NS_PER_S, y_ns, bound_ns - least_ns)
    keep = fit.inliers()
    fit = fit.select(keep).centred()
    line, residual = fit.solve()
    scale = np.diag([1.0, 1.0 / NS_PER_S])
    elapsed_ns = round(fit.origin_s * NS_PER_S)
    return ClockModel(
        anchor_ns=origin_ns + elapsed_ns,
        reference_ns=reference_origin_ns + elapsed_ns + round(line[0]),
        drift=float(line[1]) / NS_PER_S,
        cov=scale @ fit.covariance(are_delayed=least_ns > 0) @ scale,
        bias_sigma_ns=least_ns / np.sqrt(3),
        rms_ns=float(np.sqrt(residual @ residual / np.sum(fit.sigma_ns**-2.0))),
        first_ns=int(source_ns[keep].min()),
        last_ns=int(source_ns[keep].max()),
        n_used=int(keep.sum()),
        origin=f"{n_readings} {what}",
    )


def match_edges(
    source_ns: Stamps, reference_ns: Stamps, coarse: ClockModel, tolerance_ns: float
) -> tuple[Stamps, Stamps]:
    """Match edges timestamped by one clock to those of another, by a coarse model of the two.

    Args:
        source_ns: (N,) edges on one clock; rising.
        reference_ns: (M,) edges on the other; rising, more than twice the tolerance apart.
        coarse: model from one clock to the other, accurate to within the tolerance.
        tolerance_ns: largest accepted deviation.

    Returns:
        The edges (K,) on both clocks that are nearest to each other both ways and within the tolerance.
    """
    predicted_ns = coarse.convert_all(source_ns)
    edge = nearest(predicted_ns, reference_ns)
    is_mutual = nearest(reference_ns, predicted_ns)[edge] == np.arange(len(source_ns))
    keep = is_mutual & (np.abs(predicted_ns - reference_ns[edge]) <= tolerance_ns)
    return source_ns[keep], reference_ns[edge[keep]]


def nearest(these_ns: Stamps, those_ns: Stamps) -> NDArray[np.intp]:
    """Find the index (N,) of the nearest of `those_ns` to each of `these_ns`; both rising."""
    right = np.clip(np.searchsorted(those_ns, these_ns), 1, max(len(those_ns) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(those_ns) - 1)
    return np.where(these_ns - those_ns[left] <= those_ns[right] - these_ns, left, right)


@dataclass(frozen=True, eq=False)
class LineFit:
    """Readings in the order of time, and the fitted line.

        y_i = offset + drift x_i + a e_i + noise_i,      a ~ 0 +- 1 / sqrt(3)                              (1)
        sigma_i^2 = (e_0^2 + e_i^2) / 3,      e_0 the tenth part quantile of e                             (2)

    with e_i the delay that may shift reading i by up to +-e_i.

    Attributes:
        x_s: (N,) time on the source's clock.
        y_ns: (N,) the reference's time minus the source's.
        excess_ns: (N,) e_i; 0 for edges.
        origin_s: time subtracted from x to centre it.
    """

    x_s: Array
    y_ns: Array
    excess_ns: Array
    origin_s: float = 0.0

    @property
    def sigma_ns(self) -> Array:
        """The readings' standard deviations (N,) before their scatter is known (2)."""
        usual_ns = max(float(np.quantile(self.excess_ns, 0.1)), np.sqrt(3) * _FLOOR_NS)
        return np.asarray(np.sqrt((usual_ns**2 + self.excess_ns**2) / 3))

    def select(self, keep: NDArray[np.bool_]) -> "LineFit":
        """Keep the readings of a mask."""
        return replace(self, x_s=self.x_s[keep], y_ns=self.y_ns[keep], excess_ns=self.excess_ns[keep])

    def centred(self) -> "LineFit":
        """Move the origin of x to the readings' weighted mean, where offset and drift are independent."""
        mean_s = float(np.average(self.x_s, weights=self.sigma_ns**-2.0))
        return replace(self, x_s=self.x_s - mean_s, origin_s=self.origin_s + mean_s)

    def solve(self) -> tuple[Array, Array]:
        """Find offset ns, drift ns/s and a, and the residuals (N,) in sigmas."""
        design, value, information = self._normal()
        line = np.linalg.solve(information, design.T @ value)
        return line, value - design @ line

    def covariance(self, are_delayed: bool) -> Array:
        """Compute the covariance (2, 2) of offset and drift.

        The errors of edges are independent. Delays persist for a while and then change, so errors of readings
        close in time are correlated. The jackknife over stretches measures this: if its covariance is r > 1
        times that of independent readings, the latter is multiplied by r.

        References:
            `lce_rig.calibrate.quadratics.Quadratics.jackknife_covariance`, which has the factor as well.
        """
        design, value, information = self._normal()
        inverse = np.linalg.inv(information)
        residual = value - design @ (inverse @ (design.T @ value))
        n, p = len(value), 2
        scatter = max(float(residual @ residual) / (n - p), (_FLOOR_NS / float(self.sigma_ns.min())) ** 2)
        independent = scatter * inverse[:p, :p]
        if not are_delayed or n < 3 * _N_STRETCHES:
            return np.asarray(independent)
        stretches = np.array_split(np.arange(n), _N_STRETCHES)
        gradients = np.array([design[part].T @ residual[part] for part in stretches])
        hessians = np.array([design[part].T @ design[part] for part in stretches])
        steps = np.linalg.solve(information - hessians, gradients[..., None])[:, :p, 0]
        jackknife = (_N_STRETCHES - 1) / (_N_STRETCHES - p - 2) * (steps.T @ steps)
        ratio = float(np.trace(np.linalg.solve(independent, jackknife))) / p
        return np.asarray(max(ratio, 1.0) * independent)

    def inliers(self) -> NDArray[np.bool_]:
        """Find the readings (N,) within 3.5 times the usual of the line through them, each by its sigma."""
        sigma_ns = self.sigma_ns
        residual = self.y_ns - median_slope(self.x_s, self.y_ns) * self.x_s
        residual = (residual - np.median(residual)) / sigma_ns
        keep = np.ones(len(residual), dtype=np.bool_)
        for _ in range(_N_ROUNDS):
            scale = max(SIGMA_PER_MAD * float(np.median(np.abs(residual))), 1.0)
            near = np.abs(residual) <= 3.5 * scale
            if near.sum() < _MIN_INLIERS or np.ptp(self.x_s[near]) == 0 or np.array_equal(near, keep):
                break
            keep = near
            line, _ = self.select(keep).solve()
            residual = (self.y_ns - line[0] - line[1] * self.x_s - line[2] * self.excess_ns) / sigma_ns
        return keep

    def _normal(self) -> tuple[Array, Array, Array]:
        """Build the weighted design (N, 3), the values (N,), and the information (3, 3) with that on a."""
        design = np.column_stack([np.ones(len(self.x_s)), self.x_s, self.excess_ns]) / self.sigma_ns[:, None]
        return design, self.y_ns / self.sigma_ns, design.T @ design + np.diag([0.0, 0.0, 3.0])


def median_slope(x: Array, y: Array) -> float:
    """Compute the median slope between points half the data apart; robust to a quarter of outliers.

    References:
        Theil, "A rank-invariant method of linear and polynomial regression analysis", 1950 (method I).
    """
    half = len(x) // 2
    dx = x[half:] - x[: len(x) - half]
    return float(np.median((y[half:] - y[: len(y) - half])[dx > 0] / dx[dx > 0])) if (dx > 0).any() else 0.0


class ClockStep(NamedTuple):
    """A jump of one clock relative to the other.

    Attributes:
        source_ns: first reading of the source's clock after it.
        size_ns: advance of the reference relative to the source.
    """

    source_ns: int
    size_ns: int


class _Pair(NamedTuple):
    source_ns: int
    reference_ns: int
    bound_ns: float


class ClockTracker:
    """Incoming readings of two clocks, and the model fitted to the latest ones.

    A reading far from the model is held back. A single one is discarded as an outlier; three in a row that
    agree with each other mean that a clock has jumped, and start a new model.

    Attributes:
        steps: the jumps so far.
    """

    def __init__(self, what: str) -> None:
        """Start without readings; the argument names them in messages: "time requests"."""
        self.steps: list[ClockStep] = []
        self._what = what
        self._pairs: deque[_Pair] = deque(maxlen=_MAX_PAIRS)
        self._suspects: list[_Pair] = []
        self._model: ClockModel | None = None
        self._n_new = 0

    def add(self, source_ns: int, reference_ns: int, bound_ns: float = 0.0) -> None:
        """Add a reading of both clocks, and record a jump if it proves one.

        Args:
            source_ns: on the source's clock.
            reference_ns: on the reference's.
            bound_ns: bound on the time between the two.
        """
        pair = _Pair(source_ns, reference_ns, bound_ns)
        if self._pairs:
            last = self._pairs[-1]
            # Requests that overtake each other are out of order by no more than their round trips.
            if source_ns < last.source_ns - (_MIN_STEP_NS + 2 * (last.bound_ns + bound_ns)):
                self._step([pair], (reference_ns - source_ns) - (last.reference_ns - last.source_ns))
                return
        model = self._latest(max_new=max(1, len(self._pairs) // 8))
        if model is not None:
            sigma_ns = float(np.hypot(model.rms_ns, model.sigma_ns(source_ns)))
            limit_ns = max(_STEP_SIGMAS * sigma_ns, _MIN_STEP_NS) + bound_ns
            if abs(reference_ns - model.convert(source_ns)) > limit_ns:
                self._suspect(pair, model)
                return
        self._suspects.clear()
        self._pairs.append(pair)
        self._n_new += 1
        while self._pairs[0].source_ns < source_ns - _WINDOW_NS:
            self._pairs.popleft()

    @property
    def model(self) -> ClockModel | None:
        """The model of the readings so far; None with too few."""
        return self._latest(max_new=1)

    def restart(self) -> None:
        """Discard all readings after a restart of the device."""
        self._pairs.clear()
        self._suspects.clear()
        self._model = None
        self._n_new = 0

    def _latest(self, max_new: int) -> ClockModel | None:
        if self._n_new >= max_new and len(self._pairs) >= MIN_PAIRS:
            source, reference, bound = zip(*self._pairs, strict=True)
            stamps = np.array(source, np.int64), np.array(reference, np.int64)
            self._model = fit_clock(*stamps, self._what, np.array(bound))
            self._n_new = 0
        return self._model

    def _suspect(self, pair: _Pair, model: ClockModel) -> None:
        """Hold a reading back; with two before it that agree, it proves a jump."""
        self._suspects = [*self._suspects, pair][-_N_WITNESSES:]
        if len(self._suspects) < _N_WITNESSES:
            return
        sizes_ns = [suspect.reference_ns - model.convert(suspect.source_ns) for suspect in self._suspects]
        bound_ns = max(suspect.bound_ns for suspect in self._suspects)
        if max(sizes_ns) - min(sizes_ns) <= max(_STEP_SIGMAS * model.rms_ns, _MIN_STEP_NS) + 2 * bound_ns:
            self._step(self._suspects, round(float(np.median(sizes_ns))))

    def _step(self, pairs: list[_Pair], size_ns: int) -> None:
        """Start a new model with the readings that prove a jump."""
        self.steps.append(ClockStep(pairs[0].source_ns, size_ns))
        self.restart()
        self._pairs.extend(pairs)
        self._n_new = len(pairs)
