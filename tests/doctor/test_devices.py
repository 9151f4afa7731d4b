"""The computer, devices and their streams: a line for each that is absent, slow, lost or stopped."""

from pathlib import Path

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.doctor.checks import check_computer_clock, check_device, check_disk, check_stream, wanted_rate_hz
from lce_rig.doctor.observing import Examination, ObservedSensor
from lce_rig.rig import load_rig

from .observed import S, camera, codes, examination, lidar, look, make_rig


def test_sensor_that_does_not_open_is_an_error_with_hint():
    seen = ObservedSensor(
        "cam", failure=SourceError("camera 'cam': /dev/video0 is busy", "fuser -v names it.")
    )
    line = look(check_device, examination(seen), "cam")
    assert line.severity == "error" and codes(line) == ["sensor.failed"]
    assert "/dev/video0" in str(line.figures["what"]) and "fuser" in str(line.figures["hint"])
    assert look(check_stream, examination(seen), "cam") is None


def test_driver_problems_are_in_the_sensors_line():
    status = {
        "device": "DAVIS346",
        "problems": (
            Finding("device.control_differs", "warning"),
            Finding("stream.damaged_images", "warning", figures={"n": 3}),
            Finding("clock.differs_from_computer", "warning", figures={"difference_s": 1}),
        ),
    }
    exam = examination(camera(**status))
    device, stream = look(check_device, exam, "cam"), look(check_stream, exam, "cam")
    assert device.severity == stream.severity == "warning"
    assert codes(device)[1:] == ["device.control_differs"]
    assert "stream.damaged_images" in codes(stream) and "clock.differs_from_computer" not in codes(stream)
    assert {found.subject for found in (*device.findings, *stream.findings)} == {"cam"}


@pytest.mark.parametrize(
    ("rate_hz", "severity", "code"),
    [(10.0, "note", "stream.rate"), (20.0, "warning", "stream.rate_off"), (10.3, "note", "stream.rate")],
)
def test_rotor_rate_is_compared_with_profile(rate_hz, severity, code):
    line = look(check_stream, examination(lidar(rate_hz, n_packets=3770)), "lidar")
    assert line.severity == severity and codes(line) == [code, "stream.complete"]
    assert line.figures["rate_hz"] == pytest.approx(rate_hz, rel=1e-3)
    assert (line.figures["expected_hz"], line.figures["n_packets"], line.figures["n_lost"]) == (10, 3770, 0)
    assert line.findings[0].action == ("" if severity == "note" else "rotor")


def test_scans_that_arrive_late_do_not_make_the_rotor_slow():
    line = look(check_stream, examination(lidar(8.0, rates_hz={"scans": 10.01})), "lidar")
    assert line is not None and line.severity == "note" and line.figures["rate_hz"] == 10.01


@pytest.mark.parametrize(("n_lost", "severity"), [(0, "note"), (1, "warning"), (40, "error")])
def test_losses_are_counted_and_judged_by_fraction(n_lost, severity):
    line = look(check_stream, examination(lidar(n_lost=n_lost, n_packets=3770)), "lidar")
    assert line is not None and line.severity == severity
    assert ("stream.losses" in codes(line)) == (n_lost > 0)


def test_stopped_stream_is_an_error():
    seen = camera(duration_s=2.0)
    seen.ended_ns += 3 * S
    line = look(check_stream, examination(seen), "cam")
    assert (
        line is not None
        and line.severity == "error"
        and line.figures["silent_s"] == pytest.approx(3, abs=0.05)
    )


def test_triggered_camera_without_images_is_an_error():
    line = look(check_stream, examination(camera(duration_s=0.0)), "cam")
    assert line is not None and line.severity == "error" and codes(line)[0] == "stream.none"


def test_wanted_rate_of_trigger_or_driver():
    assert wanted_rate_hz(make_rig(), "cam", "command") == 20
    assert wanted_rate_hz(make_rig(), "lidar", "vlp16") == 10
    assert wanted_rate_hz(make_rig(sync=None), "cam", "command") is None
    assert wanted_rate_hz(load_rig("rles"), "davis", "davis") == 25


def test_disk_of_absent_folder_is_measured(tmp_path):
    """Nothing is left behind."""
    line = look(check_disk, Examination(make_rig(), tmp_path / "not" / "yet"))
    disk = line.findings[0]
    assert disk.figure("write_mbps") > 0 and disk.figure("free_mb") > 0
    assert disk.figures["folder"] == str(tmp_path)
    assert not list(tmp_path.iterdir())


def test_unwritable_folder_is_an_error():
    line = look(check_disk, Examination(make_rig(), Path("/proc")))
    assert line.severity == "error" and codes(line) == ["computer.disk_not_writable"]


def test_computer_clock_follows_kernel_state():
    line = look(check_computer_clock, Examination(make_rig()))
    code = "computer.clock" if line.severity == "note" else "computer.clock_not_synchronised"
    assert codes(line) == [code] and (line.severity == "note") == ("max_error_ms" in line.figures)
