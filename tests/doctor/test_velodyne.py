"""A VLP-16's lock on the pulse, as reported by its packets."""

import pytest

from lce_rig.doctor.checks import check_pps

from .observed import LOCKED, UNLOCKED, codes, examination, lidar, look, make_rig


def with_timestamps(**timestamps):
    return make_rig(lidars={"lidar": {"timestamps": {"reference": "first_firing", **timestamps}}})


def test_locked_velodyne_is_a_note_with_time():
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
def test_velodyne_pps_follows_the_profile(timestamps, severity):
    seen = lidar(clock=UNLOCKED, problems=(UNLOCKED,))
    line = look(check_pps, examination(seen, rig=with_timestamps(**timestamps)), "lidar")
    assert line is not None and line.severity == severity
    assert codes(line)[:2] == ["clock.pulse", "clock.pps_not_locked"]
