"""The sync board's block of a profile."""

import pytest
from pydantic import ValidationError

from lce_rig.core.errors import ProfileError
from lce_rig.rig import SyncSettings, dump_rig, find_profile, parse_rig

RLFS = find_profile("rlfs").read_text(encoding="utf-8")
SYNC = """
sync:
  device: /dev/ttyACM0
  triggers:
    cam: {channel: 0, rate_hz: 20}
"""


def refusal(text: str) -> str:
    with pytest.raises(ProfileError) as caught:
        parse_rig(RLFS + text, "mine.yaml")
    return str(caught.value)


def test_a_board_needs_a_device_and_little_else():
    sync = parse_rig(RLFS + SYNC).sync
    assert sync is not None
    assert (sync.type, sync.device, sync.port_baud) == ("lce1", "/dev/ttyACM0", 115200)
    assert (sync.triggers["cam"].phase_us, sync.triggers["cam"].pulse_us) == (0, 100)
    assert parse_rig(RLFS).sync is None
    assert "sync.device:" in refusal("\nsync: {type: lce1}\n")


def test_a_profile_with_a_board_reads_back_the_same():
    rig = parse_rig(RLFS + SYNC)
    assert parse_rig(dump_rig(rig)) == rig


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("cam: {", "kam: {", "sync.triggers.kam"),
        ("rate_hz: 20", "rate_hz: 20, pulse_us: 50000", "sync.triggers.cam.pulse_us"),
        ("rate_hz: 20", "rate_hz: 20, phase_us: 50000", "sync.triggers.cam.phase_us"),
        ("rate_hz: 20", "rate: 20", "sync.triggers.cam.rate"),
        ("channel: 0", "channel: 16", "sync.triggers.cam.channel"),
        ("device:", "type: nmea\n  device:", "sync.type"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_key(old, new, key):
    assert f"{key}: " in refusal(SYNC.replace(old, new))


def test_one_line_cannot_trigger_two_cameras():
    triggers = {name: {"channel": 3, "rate_hz": 10.0} for name in ("left", "right")}
    with pytest.raises(ValidationError):
        SyncSettings.model_validate({"device": "/dev/x", "triggers": triggers})
