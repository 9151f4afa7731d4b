"""The doctor examines a rig over real transports: all of it attached, parts of it, or none."""

import time

import pytest
from wire.vlp16_packets import Vlp16Clock

from lce_rig.core.findings import worst
from lce_rig.doctor.checks import Check, examine
from tests.doctor.attached import PIXELS, SCAN, Attached, attach
from tests.doctor.observed import codes, make_rig

pytestmark = pytest.mark.realtime
Lines = dict[tuple[str, str], Check]


def doctor(rig, folder, duration_s=2.0):
    checks = examine(rig, duration_s, folder)
    assert len({(check.subject, check.name) for check in checks}) == len(checks)
    return {(check.subject, check.name): check for check in checks}


def doctor_until_scanned(rig, folder, duration_s=2.0):
    """Examine a rig with an attached LiDAR; longer if a busy computer sends late."""
    for watch_s in (duration_s, 3 * duration_s, 9 * duration_s):
        start_s = time.monotonic()
        lines = doctor(rig, folder, watch_s)
        took_s = time.monotonic() - start_s
        if ("lidar", "PPS") in lines and "clock.no_position_packets" not in codes(lines["lidar", "PPS"]):
            break
    return lines, watch_s, took_s


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """The lines of a rig that is all there, how long it was watched for, and how long that took."""
    rig, folder = make_rig(), tmp_path_factory.mktemp("everything")
    with attach(Attached(rig, PIXELS, SCAN), folder) as reached:
        return doctor_until_scanned(reached, folder, 3.0)


def test_every_device_of_an_attached_rig_answers_by_name(everything):
    lines, *_ = everything
    assert lines["lidar", "device"].severity == "note"
    assert "VLP-16" in str(lines["lidar", "device"].figures["device"])
    assert lines["cam", "device"].severity == "note"
    assert "LCE1" in str(lines["sync", "device"].figures["device"])


def test_streams_arrive_without_losses(everything):
    lines, *_ = everything
    # A busy computer sends late and in bursts; the judgement of rates is tested separately.
    lidar, cam = lines["lidar", "stream"].findings, lines["cam", "stream"].findings
    assert lidar[0].figure("rate_hz") > 0 and cam[0].figure("rate_hz") > 0
    assert lidar[1].figure("n_packets") > 200
    assert lines["lidar", "stream"].figures["n_lost"] == lines["cam", "stream"].figures["n_lost"] == 0
    counts = lines["cam", "pulses"].findings[0]
    assert counts.figure("n_pulses") > 3 and counts.figure("n_frames") > 3
    by_line = {found.figures.get("line"): found for found in lines["sync", "pulses"].findings}
    assert by_line["cam"].figure("rate_hz") > 0


def test_its_lidar_is_locked(everything):
    lines, *_ = everything
    pulse = lines["lidar", "PPS"].findings[0].figures
    assert pulse["pps"] == "locked" and pulse["nmea_past_hour_s"] is not None


def test_its_clocks_are_compared(everything):
    lines, *_ = everything
    assert "host_drift_ppm" in lines["sync", "clock"].figures
    assert lines["rig", "sync"].severity in ("note", "warning")


def test_absent_camera_keeps_other_checks(tmp_path):
    rig = make_rig()
    unlocked = Vlp16Clock("absent", has_nmea=False, error_us=721_000_000)
    attached = Attached(rig, None, SCAN, unlocked)
    with attach(attached, tmp_path) as reached:
        lines, *_ = doctor_until_scanned(reached, tmp_path)
    assert lines["cam", "device"].severity == "error" and ("cam", "stream") not in lines
    assert lines["lidar", "device"].severity == "note"
    # The profile promises a clock tied by hardware.
    assert lines["lidar", "PPS"].severity == "error"
    assert "clock.pps_not_locked" in codes(lines["lidar", "PPS"])
    assert lines["sync", "device"].severity == "note"
    assert worst(found for check in lines.values() for found in check.findings) == "error"
