"""A VLP-16's settings and its lock on the pulse, from what packets and web page say."""

from typing import Any

import pytest

from lce_rig.collect.health.velodyne import check_pulse, check_settings
from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.sources.live.velodyne_web import WebReport

from .observed import examination, lidar, make_rig

LOCKED = {"pps_state": 2.0, "nmea_fix": 1.0, "nmea_past_hour_s": 754.0, "is_device_time": 1.0}
ABSENT = {"pps_state": 0.0, "is_device_time": 0.0}
ARRIVAL = "this computer's clock, by arrival: PPS is absent"


def with_timestamps(**timestamps: Any) -> Rig:
    return make_rig(lidars={"lidar": {"timestamps": {"reference": "first_firing", **timestamps}}})


def test_a_locked_sensor_is_green_with_the_time_it_was_told() -> None:
    line = check_pulse(
        examination(lidar(figures=LOCKED, clock="UTC by PPS and NMEA, +0.3 ms from it")), "lidar"
    )
    assert line is not None and line.severity == "green"
    assert line.figure == "locked, NMEA 12:34 past the hour; UTC by PPS and NMEA, +0.3 ms from it"


@pytest.mark.parametrize(
    ("timestamps", "severity"),
    [
        ({"clock": "utc", "sync": "hardware"}, "red"),
        ({"clock": "utc", "sync": "none"}, "yellow"),
        ({"clock": "host", "sync": "none"}, "green"),
    ],
)
def test_a_sensor_without_pulses_is_judged_by_what_the_profile_promises(
    timestamps: dict[str, str], severity: str
) -> None:
    problem = f"scans are stamped with {ARRIVAL}; check the pulse at the LiDAR's interface box"
    seen = lidar(figures=ABSENT, clock=ARRIVAL, problems=(problem,))
    line = check_pulse(examination(seen, rig=with_timestamps(**timestamps)), "lidar")
    assert line is not None and line.severity == severity
    assert line.figure == "absent, no NMEA; scans are stamped by arrival"
    assert line.remedy.splitlines()[0] == "Check the pulse at the LiDAR's interface box."


def test_without_position_packets_the_web_page_tells_of_the_pulse() -> None:
    seen = lidar(clock="this computer's clock, by arrival: no position packets have come")
    line = check_pulse(examination(seen, web={"lidar": WebReport(pps="locked")}), "lidar")
    assert line is not None
    assert line.figure.startswith("locked, no position packets; scans are stamped by arrival: no position")


def test_settings_that_differ_from_the_profile_are_named_once() -> None:
    report = WebReport(
        pps="absent",
        wanted_rotor_hz=20.0,
        rotor_hz=20.0,
        returns="strongest",
        fov_deg=(10, 350),
        data_port=2369,
    )
    line = check_settings(examination(lidar(), web={"lidar": report}), "lidar")
    assert line is not None and line.severity == "yellow"
    assert line.figure == "1200 rpm, strongest, 10 to 350 deg, to :2369"
    remedies = line.remedy.splitlines()
    # The pulse has a line of its own.
    assert len(remedies) == 3 and not any("PPS" in remedy for remedy in remedies)


def test_a_web_page_that_does_not_answer_is_no_fault_of_the_packets() -> None:
    web = {"lidar": SourceError("http://192.168.1.201 does not answer", "Check the network.")}
    line = check_settings(examination(lidar(), web=web), "lidar")
    assert line is not None and line.severity == "yellow" and "stay unknown" in line.remedy
