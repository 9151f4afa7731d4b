"""Find the sensor of a rig that moved during the session, from the captures of all pairs together.

A sensor that moved changes the extrinsics of all its pairs by one motion, and those of no other pair. With h
and S of `explanations` (2) for pair p, and A_p the derivative of its extrinsics by the sensor's motion s, the
cost of all pairs falls by

    chi2 = h^T S^-1 h,    h = sum_p A_p^T h_p,    S = sum_p A_p^T S_p A_p                                  (1)

Pairs count as independent, though they share images and scans: (1) ranks the sensors only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.likelihood.hypothesis import Hypothesis
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, composition_slopes, invert
from lce_rig.judge.causes import describe_move
from lce_rig.judge.explanations import Explanation, Table, score_test
from lce_rig.judge.findings import MOVED
from lce_rig.judge.validate import Validation

# Lead of a sensor over the next one, log10 of the probability: the pairs are not independent.
_LEAD = 4.0
# Standard deviation, m and rad, of motions that captures must determine better.
_KNOWN = 0.1


@dataclass(frozen=True, eq=False)
class PairCosts:
    """Captures of two sensors, and their costs under a motion of either.

    Attributes:
        sensors: names of the first and the second.
        hypothesis: the likelihood of all their captures; None for too few.
        T_first_second: (4, 4) pose of the second in the first one's frame.
        T_view: (4, 4) from the first one's frame to that of the likelihood.
        used: captures of the result.
        moved: the motion that these captures alone show, if they do.
    """

    sensors: tuple[str, str]
    hypothesis: Hypothesis | None
    T_first_second: Array
    T_view: Array
    used: tuple[str, ...]
    moved: Finding | None

    @classmethod
    def of(
        cls,
        sensors: tuple[str, str],
        estimate: CalibrationEstimate,
        validation: Validation,
        T_view: Array | None = None,
    ) -> "PairCosts":
        """Collect captures and costs of an estimate and its checks; T_view None: the first sensor's frame."""
        T_view = np.eye(4) if T_view is None else T_view
        T_first_second = np.asarray(invert(T_view) @ estimate.T_cam_lidar)
        reasons = [f for f in validation.causes if f.code == MOVED.code and f.severity != "note"]
        moved = reasons[0] if reasons and reasons[0].figures["place"] else None
        return cls(sensors, validation.hypothesis, T_first_second, T_view, estimate.used, moved)

    def slopes(self, sensor: str) -> Array:
        """Differentiate the likelihood's extrinsics by a motion of one sensor, in its frame: (6, 6)."""
        if sensor == self.sensors[0]:
            by_view = composition_slopes(self.T_view, self.T_first_second)[1]
            return by_view @ composition_slopes(np.eye(4), self.T_first_second)[0]
        return -composition_slopes(self.T_view @ self.T_first_second, np.eye(4))[1]


@dataclass(frozen=True, eq=False)
class MovedSensor:
    """A sensor that moved.

    Attributes:
        name: name of the sensor.
        first_after: the first capture after its motion.
        log10_chance: log10 of the probability of such a fall of the cost without a motion.
        shown: the motion as captures of one of its pairs show it.
    """

    name: str
    first_after: str
    log10_chance: float
    shown: Finding

    def is_within(self, pair: PairCosts) -> bool:
        """Check whether a pair of this sensor used captures from before the motion."""
        return self.name in pair.sensors and min(pair.used) < self.first_after

    def finding(self, pair: PairCosts) -> Finding:
        """Report the motion for a pair of this sensor: a note if its result uses only captures after it."""
        held = pair.used if pair.hypothesis is None else pair.hypothesis.captures
        move = describe_move(held, sum(name < self.first_after for name in held))
        if move["place"] == "first":
            move["neighbour"] = self.first_after  # of any pair: this one may lack the capture
        return replace(
            self.shown,
            severity=self.shown.severity if self.is_within(pair) else "note",
            figures={**self.shown.figures, **move, "sensor": self.name},
        )


def with_motion(validation: Validation, pair: PairCosts, moved: MovedSensor | None) -> Validation:
    """Name the sensor that moved as the cause in a pair's checks; other causes may follow from it.

    Args:
        validation: checks of a pair.
        pair: its captures.
        moved: the sensor; None if none moved.
    """
    if moved is None or moved.name not in pair.sensors:
        return validation
    if pair.moved is not None:
        named = replace(pair.moved, figures={**pair.moved.figures, "sensor": moved.name})
        causes = [named if each is pair.moved else each for each in validation.causes]
        return replace(validation, causes=causes)
    found, others = moved.finding(pair), list(validation.causes)
    if found.severity != "note":
        others = [replace(each, severity="note") for each in others]
    return replace(validation, causes=[found, *others])


def find_moved_sensor(pairs: Sequence[PairCosts]) -> MovedSensor | None:
    """Find the sensor whose motion explains the captures of all pairs best.

    Args:
        pairs: pairs of a rig.

    Returns:
        The sensor; None if no pair's captures show a motion, or if several sensors explain them as well.
    """
    shown = [pair for pair in pairs if pair.moved is not None]
    if len(pairs) < 2 or not shown:
        return None
    names = sorted(set.intersection(*(set(pair.sensors) for pair in shown)))
    motions = [min(_motions(name, pairs), key=lambda each: each.log10_chance) for name in names]
    ranked = sorted(motions, key=lambda each: each.log10_chance)
    # At most two sensors are part of all pairs that show a motion.
    next_chance = ranked[1].log10_chance if len(ranked) > 1 else 0.0
    return ranked[0] if ranked and ranked[0].log10_chance < next_chance - _LEAD else None


def _motions(sensor: str, pairs: Sequence[PairCosts]) -> Iterator[MovedSensor]:
    """List the motions that captures of single pairs show, as motions of one sensor."""
    own = [
        (pair.hypothesis.captures, Table(pair.hypothesis, frozenset()).poses, pair.slopes(sensor))
        for pair in pairs
        if sensor in pair.sensors and pair.hypothesis is not None
    ]
    for shown in (pair.moved for pair in pairs if pair.moved is not None and sensor in pair.sensors):
        first_after = _first_after(shown)
        h, S = np.zeros(6), np.zeros((6, 6))
        for captures, poses, A in own:
            slope, information = poses.score(np.array([float(name >= first_after) for name in captures]))
            h, S = h + A.T @ slope, S + A.T @ information @ A
        found = score_test(Explanation("moved", np.empty(0)), h, S, _KNOWN)
        yield MovedSensor(sensor, first_after, found.log10_chance, shown)


def _first_after(moved: Finding) -> str:
    """Return the first capture after a motion."""
    captures = moved.figures["captures"]
    assert isinstance(captures, tuple)
    return str(moved.figures["neighbour"] if moved.figures["place"] == "first" else captures[0])
