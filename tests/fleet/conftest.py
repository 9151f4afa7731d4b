"""Rows of a fleet's table, as results give them."""

from collections.abc import Callable

import numpy as np
import pytest

from lce_rig.fleet.table import Row


@pytest.fixture
def row() -> Callable[..., Row]:
    def make(robot: str = "r1", date: str = "2026-01-05T10:00:00Z", **changes: object) -> Row:
        known: dict[str, object] = {
            "rig": "rlfs",
            "folder": f"{robot}/{date[:10]}-0123456789ab",
            "camera": "cam",
            "lidar": "lidar",
            "verdict": "pass",
            "findings": ("verdict.largest_cause",),
            "severities": ("note",),
            "T_cam_lidar": tuple(np.eye(4).ravel().tolist()),
            "cov": tuple(float(k) for k in range(21)),
            "n_used": 8,
        }
        return Row(robot, date=date, **(known | changes))  # type: ignore[arg-type]

    return make
