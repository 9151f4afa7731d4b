"""The computer itself: Python and its packages, system libraries, disk, network buffer and clock."""

import ctypes
import os
import platform
import shutil
import socket
import sys
import tempfile
import time
from importlib import metadata, resources
from importlib.util import find_spec
from pathlib import Path

from lce_rig.core import velodyne
from lce_rig.core.findings import Figure, Finding
from lce_rig.devices.udp_port import PACKET_COST_BYTES, WANTED_BUFFER_BYTES
from lce_rig.doctor.line import Check
from lce_rig.doctor.sensor_sources import uses_driver
from lce_rig.rig import Rig

_GROUP = "computer"
# Import name and distribution of what collecting and calibrating import.
_PACKAGES = {
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "open3d": "open3d",
    "rosbags": "rosbags",
    "lz4": "lz4",
    "rich": "rich",
    "pydantic": "pydantic",
    "yaml": "PyYAML",
    "matplotlib": "matplotlib",
    "onnxruntime": "onnxruntime",
    "serial": "pyserial",
    "velodyne_decoder": "velodyne-decoder",
}
# What Open3D is linked with and its package does not bring, and Debian's packages of them.
_OPEN3D_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
}
# Where udev looks for rules, and what in them names a device: its USB vendor.
_UDEV = Path("/run/udev")
_UDEV_RULES = (Path("/etc/udev/rules.d"), Path("/run/udev/rules.d"), Path("/usr/lib/udev/rules.d"))
_DAVIS_VENDOR, _TEENSY_VENDOR = "152a", "16c0"
_MIN_BUFFER_S = 0.25
_PROBE_BYTES, _PROBE_BLOCK_BYTES, _PROBE_S = 48 << 20, 4 << 20, 0.5
_MB = 1e6
# A capture is a few MB; raw images of 1280x720 px at 30 Hz are 55 MB/s.
_MIN_FREE_MB, _SCARCE_MB = 500.0, 5000.0
_MIN_WRITE_MBPS, _SLOW_WRITE_MBPS = 2.0, 20.0
# struct timex is 26 longs on 64-bit Linux; its fourth is the largest error, us.
_TIMEX_LONGS, _MAX_ERROR_LONG, _TIME_ERROR = 32, 3, 5


def check_python(rig: Rig, folder: Path) -> Check:
    """Name Python, numpy and the machine; the drivers read 64-bit interfaces of Linux only."""
    n_bits = 8 * ctypes.sizeof(ctypes.c_void_p)
    figures: dict[str, Figure] = {
        "python": platform.python_version(),
        "numpy": metadata.version("numpy"),
        "system": platform.system(),
        "machine": platform.machine(),
        "n_bits": n_bits,
    }
    is_fit = sys.platform == "linux" and n_bits == 64
    wrong = None if is_fit else Finding("computer.not_linux_64")
    return Check.of(_GROUP, "python", Finding("computer.python", "note", figures=figures), wrong)


def check_packages(rig: Rig, folder: Path) -> Check:
    """Look for the packages, and for dv-processing where the rig has a DAVIS."""
    missing = tuple(name for module, name in _PACKAGES.items() if find_spec(module) is None)
    if missing:
        figures: dict[str, Figure] = {"packages": missing}
        return Check.of(_GROUP, "packages", Finding("computer.packages_missing", figures=figures))
    needs_davis = uses_driver(rig, "davis")
    if needs_davis and find_spec("dv_processing") is None:
        return Check.of(_GROUP, "packages", Finding("computer.dv_processing_missing"))
    found = {
        "n": len(_PACKAGES),
        "opencv": _version("opencv-python-headless"),
        "dv_processing": _version("dv-processing") if needs_davis else None,
    }
    return Check.of(_GROUP, "packages", Finding("computer.packages", "note", figures=found))


def check_libraries(rig: Rig, folder: Path) -> Check:
    """Try to load the system libraries that Open3D is linked with; only `simulate` needs it."""
    missing = tuple(name for name in _OPEN3D_LIBRARIES if not _loads(name))
    if missing:
        packages = tuple(_OPEN3D_LIBRARIES[name] for name in missing)
        absent: dict[str, Figure] = {"libraries": missing, "packages": packages}
        return Check.of(_GROUP, "libraries", Finding("computer.libraries_missing", "warning", figures=absent))
    figures: dict[str, Figure] = {"libraries": tuple(_OPEN3D_LIBRARIES)}
    return Check.of(_GROUP, "libraries", Finding("computer.libraries", "note", figures=figures))


def check_disk(rig: Rig, folder: Path) -> Check:
    """Measure the free space of a folder's disk, and how fast it takes data that are flushed to it."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        free_mb = shutil.disk_usage(there).free / _MB
        write_mbps = _write_speed_mbps(there)
    except OSError as error:
        refused = {"folder": str(there), "cause": error.strerror}
        return Check.of(_GROUP, "disk", Finding("computer.disk_not_writable", figures=refused))
    figures: dict[str, Figure] = {"free_mb": free_mb, "write_mbps": write_mbps, "folder": str(there)}
    wrong = None
    if free_mb < _SCARCE_MB:
        wrong = Finding("computer.disk_full", "error" if free_mb < _MIN_FREE_MB else "warning")
    elif write_mbps < _SLOW_WRITE_MBPS:
        wrong = Finding("computer.disk_slow", "error" if write_mbps < _MIN_WRITE_MBPS else "warning")
    return Check.of(_GROUP, "disk", Finding("computer.disk", "note", figures=figures), wrong)


def check_socket_buffer(rig: Rig, folder: Path) -> Check | None:
    """Ask the kernel for the receive buffer of a VLP-16's port, and see how much it grants."""
    if not uses_driver(rig, "vlp16"):
        return None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        # Linux doubles what was asked for, for its own accounts, and reports the double.
        granted_bytes = port.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    buffer_s = granted_bytes / PACKET_COST_BYTES * velodyne.READ[0].packet_ns(False) * 1e-9
    figures = {
        "buffer_s": buffer_s,
        "granted_kib": granted_bytes >> 11,
        "wanted_bytes": WANTED_BUFFER_BYTES,
    }
    wrong = Finding("computer.buffer_small", "warning", figures=figures) if buffer_s < _MIN_BUFFER_S else None
    return Check.of(_GROUP, "buffer", Finding("computer.buffer", "note", figures=figures), wrong)


def check_udev_rules(rig: Rig, folder: Path) -> Check | None:
    """Look for udev rules of a DAVIS and of a sync board, which a user could not open without."""
    wanted = {_DAVIS_VENDOR: "DAVIS"} if uses_driver(rig, "davis") else {}
    if rig.sync is not None and rig.sync.type == "lce1":
        wanted[_TEENSY_VENDOR] = "sync board"
    if not wanted or not _UDEV.is_dir():  # in a container the host's rules count
        return None
    files = [path for place in _UDEV_RULES if place.is_dir() for path in place.glob("*.rules")]
    rules = "".join(path.read_text(encoding="utf-8", errors="replace") for path in files)
    devices = tuple(device for vendor, device in wanted.items() if f'"{vendor}"' not in rules)
    if devices:
        shipped = str(resources.files("lce_rig") / "devices" / "60-lce-rig.rules")
        absent: dict[str, Figure] = {"devices": devices, "rules": shipped}
        return Check.of(
            _GROUP, "udev rules", Finding("computer.udev_rules_missing", "warning", figures=absent)
        )
    figures: dict[str, Figure] = {"devices": tuple(wanted.values())}
    return Check.of(_GROUP, "udev rules", Finding("computer.udev_rules", "note", figures=figures))


def check_clock(rig: Rig, folder: Path) -> Check:
    """Ask the kernel whether something keeps the computer's clock right; a VLP-16's hour is taken from it."""
    timex = (ctypes.c_long * _TIMEX_LONGS)()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    if state in (-1, _TIME_ERROR):
        return Check.of(_GROUP, "clock", Finding("computer.clock_not_synchronised", "warning"))
    figures = {"max_error_ms": timex[_MAX_ERROR_LONG] / 1000}
    return Check.of(_GROUP, "clock", Finding("computer.clock", "note", figures=figures))


COMPUTER_CHECKS = (
    check_python,
    check_packages,
    check_libraries,
    check_disk,
    check_socket_buffer,
    check_udev_rules,
    check_clock,
)
"""Every check of the computer: each takes the rig and the folder of sessions; None where there is no need."""


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _write_speed_mbps(folder: Path) -> float:
    """Write for half a second at most, each block flushed to the disk as a capture's files are."""
    block = os.urandom(_PROBE_BLOCK_BYTES)  # disks that compress are not fooled
    n_bytes, start_s = 0, time.monotonic()
    with tempfile.TemporaryFile(dir=folder) as file:
        while n_bytes < _PROBE_BYTES and time.monotonic() - start_s < _PROBE_S:
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            n_bytes += len(block)
    return n_bytes / _MB / max(time.monotonic() - start_s, 1e-9)
