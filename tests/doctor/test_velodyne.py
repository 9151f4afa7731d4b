"""A VLP-16's settings and its lock on the pulse, from what packets and web page say."""

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.doctor.checks import check_pps, check_settings

from .observed import LOCKED, UNLOCKED, codes, examination, lidar, look, make_rig


def with_timestamps(**timestamps):
    return make_rig(lidars={"lidar": {"timestamps": {"reference": "first_firing", **timestamps}}})


def test_a_locked_sensor_is_green_with_the_time_it_was_told():
    line = look(check_pps, examination(lidar(clock=LOCKED)), "lidar")
    assert line is not None and line.severity == "note"
    assert codes(line) == ["clock.pulse", "clock.lidar_utc"]
    assert (line.figures["pps"], line.figures["nmea_past_hour_s"]) == ("locked", 754)


@pytest.mark.parametrize(
    ("timestamps", "severity"),
    [
        ({"clock": "utc", "sync": "hardware"}, "error"),
        ({"clock": "utc", "sync": "none"}, "warning"),
        ({"clock": "host", "sync": "none"}, "note"),
    ],
)
def test_a_sensor_without_pulses_is_judged_by_what_the_profile_promises(timestamps, severity):
    seen = lidar(clock=UNLOCKED, problems=(UNLOCKED,))
    line = look(check_pps, examination(seen, rig=with_timestamps(**timestamps)), "lidar")
    assert line is not None and line.severity == severity
    assert codes(line)[:2] == ["clock.pulse", "clock.pps_not_locked"]


def test_settings_that_differ_from_the_profile_are_named_once():
    report = {"pps": "absent", "rpm": 1200.0, "returns": "strongest", "fov_deg": (10, 350), "data_port": 2369}
    line = look(check_settings, examination(lidar(), web={"lidar": report}), "lidar")
    assert line is not None and line.severity == "warning"
    # The pulse has a line of its own.
    assert codes(line)[0] == "settings.read"
    assert [each.figures["setting"][:4] for each in line.findings[1:]] == ["rpm", "fiel", "data"]


def test_a_web_page_that_does_not_answer_is_no_fault_of_the_packets():
    web = {"lidar": SourceError("http://192.168.1.201 does not answer", "Check the network.")}
    line = look(check_settings, examination(lidar(), web=web), "lidar")
    assert line is not None and line.severity == "warning" and codes(line) == ["settings.unknown"]
