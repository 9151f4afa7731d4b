"""The computer's lines say what the kernel and the disk do."""

import shutil
import socket
from importlib.util import find_spec
from pathlib import Path

import pytest

from lce_rig.doctor import computer
from lce_rig.doctor.examination import Examination
from lce_rig.rig import Rig, load_rig

from .observed import codes, look, make_rig


def test_a_missing_package_is_named_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computer, "_PACKAGES", {"no_such_module": "no-such-package"})
    line = look(computer.check_packages, Examination(make_rig()))
    assert line.severity == "error" and codes(line) == ["computer.packages_missing"]
    assert line.figures["packages"] == ("no-such-package",)


def test_a_rig_with_a_davis_needs_its_library() -> None:
    line = look(computer.check_packages, Examination(load_rig("rles")))
    is_there = find_spec("dv_processing") is not None
    assert codes(line) == ["computer.packages" if is_there else "computer.dv_processing_missing"]
    assert not is_there or line.figures["dv_processing"]


def test_a_missing_system_library_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computer, "_OPEN3D_LIBRARIES", {"libnosuch.so.7": "libnosuch7"})
    line = look(computer.check_libraries, Examination(make_rig()))
    assert line.severity == "warning"
    assert (line.figures["libraries"], line.figures["packages"]) == (("libnosuch.so.7",), ("libnosuch7",))


def test_the_disk_of_a_folder_that_is_not_there_yet_is_measured_and_left_clean(tmp_path: Path) -> None:
    line = look(computer.check_disk, Examination(make_rig(), tmp_path / "not" / "yet"))
    disk = line.findings[0]
    assert disk.figure("write_mbps") > 0 and disk.figure("free_mb") > 0
    assert disk.figures["folder"] == str(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_red() -> None:
    line = look(computer.check_disk, Examination(make_rig(), Path("/proc")))
    assert line.severity == "error" and codes(line) == ["computer.disk_not_writable"]


def test_the_receive_buffer_is_what_the_kernel_grants() -> None:
    line = look(computer.check_socket_buffer, Examination(make_rig()))
    assert line is not None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        granted_bytes = port.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    buffer_s = line.findings[0].figure("buffer_s")
    assert line.figures["granted_kib"] == granted_bytes // 2048
    # 754 packets a second of 2304 bytes each, as the kernel counts.
    assert buffer_s == pytest.approx(granted_bytes / 2304 / 753.5, rel=1e-3)
    assert ("computer.buffer_small" in codes(line)) == (buffer_s < 0.25) == (line.severity == "warning")


@pytest.fixture
def udev(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of udev rules, the only one."""
    monkeypatch.setattr(computer, "_UDEV", tmp_path)
    monkeypatch.setattr(computer, "_UDEV_RULES", (tmp_path,))
    return tmp_path


@pytest.mark.parametrize(
    ("rig", "device"),
    [(load_rig("rles"), "DAVIS"), (make_rig(sync={"device": "/dev/ttyACM0"}), "sync board")],
)
def test_devices_want_udev_rules_and_the_shipped_ones_do(udev: Path, rig: Rig, device: str) -> None:
    line = look(computer.check_udev_rules, Examination(rig))
    assert line is not None and codes(line) == ["computer.udev_rules_missing"]
    assert line.severity == "warning" and line.figures["devices"] == (device,)
    shutil.copy(str(line.figures["rules"]), udev)
    assert codes(look(computer.check_udev_rules, Examination(rig))) == ["computer.udev_rules"]


def test_the_clock_is_judged_by_the_kernel() -> None:
    line = look(computer.check_clock, Examination(make_rig()))
    code = "computer.clock" if line.severity == "note" else "computer.clock_not_synchronised"
    assert codes(line) == [code] and (line.severity == "note") == ("max_error_ms" in line.figures)
