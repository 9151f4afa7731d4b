"""Each camera and LiDAR in time, from the table."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import exp_so3, perturb, pose
from lce_rig.fleet.history import STATES, history_of
from lce_rig.fleet.table import Row, as_table

SIGMA = np.array([2e-3, 2e-3, 3e-3, *np.radians([0.06, 0.06, 0.04])])
UPPER = np.triu_indices(6)
STILL = np.zeros(6)


@pytest.fixture
def session(row):
    """Rows of sessions, drawn from their covariance."""
    rng = np.random.default_rng(0)

    def make(robot, number, moved=STILL, **changes) -> Row:
        T = perturb(pose(exp_so3(np.array([0.1, 1.5, -0.2])), np.array([0.1, -0.2, 0.05])), moved)
        known = {
            "date": f"2026-01-{number + 1:02d}T10:00:00Z",
            "session_sha256": f"{robot}{number}",
            "T_cam_lidar": tuple(perturb(T, SIGMA * rng.normal(size=6)).ravel().tolist()),
            "cov": tuple(np.diag(SIGMA**2)[UPPER].tolist()),
            "cov_shared": tuple(np.zeros(21).tolist()),
        }
        return row(robot, **(known | changes))

    return make


def nudge(axis, size):
    return size * np.eye(6)[axis]


def test_the_robot_that_moved_is_named_with_date_and_axis(session):
    rows = [session(robot, k) for robot in ("r1", "r3") for k in range(6)]
    rows += [session("r2", k, nudge(4, np.radians(0.7) if k > 2 else 0.0)) for k in range(6)]
    history = history_of(as_table(rows))
    assert history.robots == {"r1": "steady", "r2": "moved", "r3": "steady"}
    (change,) = history.changes
    assert (change.robot, change.before, change.after) == (
        "r2",
        "2026-01-03T10:00:00Z",
        "2026-01-04T10:00:00Z",
    )
    (axis,) = change.found.axes
    assert axis.axis == "rotation_y" and abs(axis.change - 0.7) < 4 * axis.sigma


def test_rows_in_any_order_give_the_same(session):
    rows = [session("r1", k, nudge(0, 0.03 if k > 3 else 0.0)) for k in range(8)]
    one, other = (history_of(as_table(each)) for each in (rows, rows[::-1]))
    assert one.changes == other.changes and len(one.changes) == 1
    assert np.array_equal(other.rows, 7 - one.rows)


def test_results_that_must_not_be_used_are_left_out(session):
    wrong = {"verdict": "fail", "findings": ("verdict.control",), "severities": ("error",)}
    far = {"verdict": "fail", "findings": ("verdict.far_from_nominal",), "severities": ("error",)}
    rows = [session("r1", k) for k in range(4)]
    rows += [session("r1", 4, nudge(3, 0.1), **wrong), Row("r1", status="crashed")]
    history = history_of(as_table(rows))
    assert (history.n_failed, len(history.rows), history.n_rows) == (1, 4, 6)
    assert history.robots == {"r1": "steady"}
    rows += [session("r1", k, nudge(3, 0.1), **far) for k in (5, 6)]
    assert history_of(as_table(rows)).robots == {"r1": "moved"}


def test_the_same_session_counts_once(session):
    rows = [session("r1", k) for k in range(3)]
    twice = replace(rows[0], folder="r1/elsewhere")
    assert len(history_of(as_table([*rows, twice])).rows) == 3


def test_another_sensor_begins_another_series(session):
    rows = [session("r1", k, camera_serial="A") for k in range(4)]
    rows += [session("r1", k, nudge(3, 0.1), camera_serial="B") for k in range(4, 8)]
    history = history_of(as_table(rows))
    assert history.changes == () and len(history.starts) == 3
    assert history.names["camera_serial"].to_pylist() == ["A", "B"]


def test_of_several_cameras_the_one_that_moved_alone_is_named_and_else_the_lidar(session):
    for moving, sensor in ((("a",), "camera"), (("a", "b"), "lidar")):
        rows = []
        for camera in ("a", "b"):
            size = 0.03 if camera in moving else 0.0
            rows += [session("r1", k, nudge(0, size if k > 3 else 0.0), camera=camera) for k in range(8)]
        history = history_of(as_table(rows))
        assert [change.sensor for change in history.changes] == [sensor] * len(moving)


def test_a_robot_of_one_session_says_so_and_an_empty_table_gives_nothing(session):
    history = history_of(as_table([session("r1", 0)]))
    assert history.robots == {"r1": "once"} and STATES[history.state[0]] == "once"
    empty = history_of(as_table([]))
    assert empty.robots == {} and empty.changes == ()
