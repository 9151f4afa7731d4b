"""The computer's lines say what the kernel and the disk do."""

import socket
from pathlib import Path

import pytest

from lce_rig.collect.health import computer, worst
from lce_rig.rig import load_rig

from .observed import make_rig


def test_the_worst_of_several_lines_decides() -> None:
    assert worst([]) == "green"
    assert worst(["green", "red", "yellow"]) == "red"
    assert worst(["yellow", "green"]) == "yellow"


def test_python_and_the_packages_of_these_tests_are_in_order() -> None:
    line = computer.check_python(make_rig(), Path())
    assert line.severity == "green" and "numpy" in line.figure
    assert computer.check_packages(make_rig(), Path()).severity == "green"


def test_a_missing_package_is_named_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computer, "_PACKAGES", {"no_such_module": "no-such-package"})
    line = computer.check_packages(make_rig(), Path())
    assert (line.severity, line.remedy) == ("red", "Run: pip install no-such-package")


def test_a_rig_with_a_davis_needs_its_library() -> None:
    line = computer.check_packages(load_rig("rles"), Path())
    assert "dv-processing" in line.figure
    assert line.severity == "green" or "pip install 'lce-rig[davis]'" in line.remedy


def test_a_missing_system_library_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computer, "_OPEN3D_LIBRARIES", {"libnosuch.so.7": "libnosuch7"})
    line = computer.check_libraries(make_rig(), Path())
    assert line.severity == "yellow"
    assert "libnosuch.so.7" in line.figure and line.remedy == "Run: sudo apt install libnosuch7"


def test_the_disk_of_a_folder_that_is_not_there_yet_is_measured_and_left_clean(tmp_path: Path) -> None:
    line = computer.check_disk(make_rig(), tmp_path / "not" / "yet")
    assert line.values["write_mbps"] > 0 and line.values["free_mb"] > 0
    assert str(tmp_path) in line.figure
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_red() -> None:
    line = computer.check_disk(make_rig(), Path("/proc"))
    assert line.severity == "red" and "-o" in line.remedy


def test_the_receive_buffer_is_what_the_kernel_grants() -> None:
    line = computer.check_socket_buffer(make_rig(), Path())
    assert line is not None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        granted_bytes = port.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    assert line.values["granted_bytes"] == granted_bytes
    # 754 packets a second of 2304 bytes each, as the kernel counts.
    assert line.values["buffer_s"] == pytest.approx(granted_bytes / 2304 / 753.5, rel=1e-3)
    assert (line.severity == "yellow") == (line.values["buffer_s"] < 0.25) == ("rmem_max" in line.remedy)


def test_a_rig_without_a_vlp16_needs_no_buffer() -> None:
    rig = make_rig(lidars={"lidar": {"model": "another"}})
    assert computer.check_socket_buffer(rig, Path()) is None


def test_the_clock_is_judged_by_the_kernel() -> None:
    line = computer.check_clock(make_rig(), Path())
    assert (line.severity == "green") == ("max_error_ms" in line.values)
    assert (line.severity == "yellow") == ("timedatectl" in line.remedy)
