"""Moving boards are compared with the extrinsics after motion compensation."""

import numpy as np
import pytest

from lce_rig.calibrate import Clocks
from lce_rig.calibrate.result import capture_residual
from lce_rig.core.calibration import Calibration, Certificate, ChannelResult, Metrics
from lce_rig.core.geometry import Array, transform
from lce_rig.core.results import Observation
from lce_rig.judge.session_check import bring_together, match_candidates
from tests.calibrate.boards import BOARD, T_FORWARD
from tests.calibrate.moving_boards import Moving, simulate_moving
from tests.saved_results import made_calibration

CLOCKS = Clocks(tolerance_s={"frames": 0.1, "events": 0.1})
MOVING = Moving(speed_mps=0.3, tracked=("events",))


def calibration_of(results: tuple[ChannelResult, ...]) -> Calibration:
    return made_calibration(
        T_FORWARD,
        np.eye(6) * 1e-6,
        channels=tuple(result.channel for result in results),
        certificate=Certificate(True, 0.0),
        metrics=Metrics(0.0, 0.0, 0.0),
        n_captures=12,
        n_detected=12,
        captures_used=(),
        channel_results=results,
    )


def result_of(channel: str, offset_s: float | None) -> ChannelResult:
    noise_px = {"frames": 0.1, "events": 0.2}[channel]
    return ChannelResult(channel, 12, noise_px, offset_s, 0.001)


@pytest.fixture(scope="module")
def observations() -> dict[str, list[Observation]]:
    found = {}
    for channel, items in simulate_moving(12, 7, MOVING).items():
        found[channel] = [match_candidates(item, BOARD, T_FORWARD) for item in items]
    return found


@pytest.fixture(scope="module")
def timed() -> Calibration:
    return calibration_of(tuple(result_of(channel, offset_s) for channel, offset_s in MOVING.offset_s))


def planes_m(observations: list[Observation]) -> Array:
    return np.array([capture_residual(T_FORWARD, o, BOARD).plane_rms_m for o in observations])


@pytest.mark.parametrize("channel", ["frames", "events"])
def test_planes_meet_after_motion_compensation(
    observations: dict[str, list[Observation]], timed: Calibration, channel: str
) -> None:
    meetings = bring_together(observations, channel, T_FORWARD, timed.channel_results, CLOCKS)
    assert list(meetings) == [o.capture for o in observations[channel]]
    together = planes_m([meeting.at_scan_time for meeting in meetings.values()])
    apart = planes_m([meeting.measured for meeting in meetings.values()])
    # 10 mm is the range noise; a board at 0.3 m/s per axis is captured up to 0.1 s apart.
    assert np.sqrt(np.mean(together**2)) < 0.014 < np.sqrt(np.mean(apart**2))


@pytest.mark.parametrize("channel", ["frames", "events"])
def test_meetings_move_lidar_to_image_time(
    observations: dict[str, list[Observation]], timed: Calibration, channel: str
) -> None:
    for meeting in bring_together(observations, channel, T_FORWARD, timed.channel_results, CLOCKS).values():
        T_cam_board = meeting.measured.image.T_cam_board
        moved = transform(T_FORWARD, meeting.lidar_at_image_time.points)
        distance_m = (moved - T_cam_board[:3, 3]) @ T_cam_board[:3, 2]
        assert abs(np.mean(distance_m)) < 0.01
        way_m = np.linalg.norm(
            meeting.lidar_at_image_time.points.mean(axis=0) - meeting.measured.lidar.points.mean(axis=0)
        )
        assert meeting.way_m == pytest.approx(way_m, abs=0.005)


def test_meetings_without_offsets_are_still(
    observations: dict[str, list[Observation]],
) -> None:
    still = calibration_of((result_of("frames", None),))
    for meeting in bring_together(observations, "frames", T_FORWARD, still.channel_results, CLOCKS).values():
        assert meeting.at_scan_time is meeting.measured
        assert meeting.lidar_at_image_time is meeting.measured.lidar
        assert meeting.way_m == 0


def test_a_channel_without_observations_gives_none(timed: Calibration) -> None:
    assert bring_together({"frames": []}, "frames", T_FORWARD, timed.channel_results, CLOCKS) == {}
