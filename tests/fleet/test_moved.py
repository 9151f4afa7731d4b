"""Robots that moved: results compared with the one before them."""

import numpy as np
import pytest

from lce_rig.core.geometry import perturb
from lce_rig.fleet.registry import as_table
from lce_rig.fleet.report import history_of

SIGMA = np.array([2e-3, 2e-3, 3e-3, *np.radians([0.06, 0.06, 0.04])])
UPPER = np.triu_indices(6)


@pytest.fixture
def result(row):
    """Return the row of session k of a robot, at a tangent in standard deviations."""

    def make(robot, k, tangent=(0, 0, 0, 0, 0, 0), *, shared=0.0, **changes):
        T = perturb(np.eye(4), SIGMA * np.asarray(tangent, dtype=float))
        known = {
            "date": f"2026-01-{k + 1:02d}T10:00:00Z",
            "folder": f"{robot}/{k}",
            "session_sha256": f"{robot}{k}",
            "T_cam_lidar": tuple(T.ravel().tolist()),
            "cov": tuple(np.diag((1 + shared) * SIGMA**2)[UPPER].tolist()),
            "cov_shared": tuple(np.diag(shared * SIGMA**2)[UPPER].tolist()),
        }
        return row(robot, **(known | changes))

    return make


MOVE = (0, 0, 0, 0, 14, 0)


def test_a_move_is_named_with_its_dates_and_sizes(result):
    history = history_of(as_table([result("r1", k, MOVE if k > 1 else (0,) * 6) for k in range(4)]))
    (finding,) = [history.finding(k) for k in history.moves]
    assert (finding.code, finding.subject) == ("fleet.moved", "r1")
    assert finding.figures["before"] == "2026-01-02T10:00:00Z"
    assert finding.figures["after"] == "2026-01-03T10:00:00Z"
    assert finding.figures["rotation_deg"] == pytest.approx(0.84)
    assert finding.figures["chi2"] == pytest.approx(14**2 / 2, rel=1e-3)
    assert history.robots == {"r1": "moved"}


@pytest.mark.parametrize(
    "changes",
    [
        {"verdict": "fail", "findings": ("verdict.moved",), "severities": ("error",)},
        {"status": "failed"},
        {"cov": None},
        {"date": None},
        {"lidar_serial": "AG2"},
        {"camera": "another"},
        {"session_sha256": "r10"},
    ],
)
def test_moved_without_comparison_is_unknown(result, changes):
    rows = [result("r1", 0, lidar_serial="AG1"), result("r1", 1, MOVE, **({"lidar_serial": "AG1"} | changes))]
    assert history_of(as_table(rows)).robots == {"r1": "cannot_tell"}


def test_moved_far_from_nominal_counts(result):
    far = {"verdict": "fail", "findings": ("verdict.far_from_nominal",), "severities": ("error",)}
    assert history_of(as_table([result("r1", 0), result("r1", 1, MOVE, **far)])).robots == {"r1": "moved"}


def test_moved_shared_errors_need_a_change(result):
    """They count between profiles or methods only."""

    def state(**changes):
        rows = [result("r1", 0, shared=99.0), result("r1", 1, MOVE, shared=99.0, **changes)]
        return history_of(as_table(rows)).robots["r1"]

    assert state() == "moved"
    assert state(method="paper") == state(profile_sha256="0f") == "steady"


def test_moved_false_alarm_rate_is_as_stated(result):
    rng = np.random.default_rng(0)
    rows = [result(f"r{r}", k, rng.normal(size=6)) for r in range(400) for k in range(5)]
    history = history_of(as_table(rows))
    chi2 = history.chi2[history.is_compared]
    assert len(chi2) == 1600 and not history.moves
    # Chi-squared with 6 degrees of freedom: its mean, and the share beyond its quantile of 99 %.
    assert chi2.mean() == pytest.approx(6, abs=0.3)
    assert np.mean(chi2 > 16.81) == pytest.approx(0.01, abs=0.007)


def test_a_table_of_nothing_has_no_robots(result):
    assert history_of(as_table([])).robots == {}
