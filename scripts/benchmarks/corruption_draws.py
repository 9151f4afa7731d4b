"""Random halves of uncorrupted sessions: any finding against them is false."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.corruption_causes import FEW, cause_of_error, independent_causes
from benchmarks.corruption_outcomes import VERDICTS
from benchmarks.corruption_sessions import SEED, Samples, calibrate_by, some_of
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import Method
from lce_rig.core.errors import LceRigError
from lce_rig.detect.detection import Detections


@dataclass(frozen=True)
class Draws:
    """Results of random halves of one sound session by one method.

    Attributes:
        session, method: which.
        n_captures: of the session.
        n_drawn: captures of each draw.
        verdicts: number of draws by verdict.
        false_causes: number of draws by the code of a false cause that is no note.
        n_false: draws with one or more of them.
    """

    session: str
    method: str
    n_captures: int
    n_drawn: int
    verdicts: Counter[str]
    false_causes: Counter[str]
    n_false: int


def draw_halves(samples: Samples, method: Method, n_draws: int, found: Detections) -> Draws:
    """Calibrate random halves of an uncorrupted session.

    Args:
        samples: the session.
        method: of the calibration.
        n_draws: how many; a half has as many captures as the profile asks for at least.
        found: the session's detections.
    """
    rng, n = np.random.default_rng(SEED), len(samples.captures)
    n_drawn = min(max((n + 1) // 2, samples.rig.quality.min_captures), n)
    verdicts, false_causes, n_false = Counter[str](), Counter[str](), 0
    for _ in range(n_draws):
        names = rng.choice(samples.captures, n_drawn, replace=False)
        try:
            calibration = calibrate_by(samples.rig, some_of(found, set(names.tolist())), method)
        except LceRigError as error:
            code = cause_of_error(error)
            # Halves may lack captures.
            false = tuple({code} - FEW)
            verdicts["refused"] += 1
        else:
            false = tuple(code for code in independent_causes(calibration) if code not in samples.faults)
            verdicts[calibration.verdict] += 1
        false_causes.update(false)
        n_false += bool(false)
    return Draws(samples.name, method, n, n_drawn, verdicts, false_causes, n_false)


def print_draws(sessions: Iterable[Sequence[Draws]]) -> None:
    """Print verdicts and false causes of random halves of sound sessions."""
    print_head(
        "session", "method", "captures", "of them drawn", *VERDICTS, "draws with a false cause", "which"
    )
    totals: dict[str, tuple[int, int]] = {}
    for draws in (each for session in sessions for each in session):
        which = ", ".join(f"{code} x {n}" for code, n in draws.false_causes.most_common())
        counts = [draws.verdicts[verdict] for verdict in VERDICTS]
        captures = draws.n_captures, draws.n_drawn
        print_row(draws.session, draws.method, *captures, *counts, draws.n_false, which)
        n_false, n_draws = totals.get(draws.method, (0, 0))
        totals[draws.method] = n_false + draws.n_false, n_draws + sum(counts)
    print()
    for method, (n_false, n_draws) in totals.items():
        print(f"{method}: {n_false} of {n_draws} draws name a false cause")
