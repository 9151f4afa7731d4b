"""The computer itself: Python and its packages, system libraries, disk, network buffer and clock."""

import ctypes
import os
import platform
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata, resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lce_rig.core import velodyne
from lce_rig.core.findings import Finding
from lce_rig.devices.udp_port import PACKET_COST_BYTES, WANTED_BUFFER_BYTES
from lce_rig.doctor import findings
from lce_rig.doctor.examination import Examination, driver_of, sensors
from lce_rig.rig import Rig

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
    "dpkt": "dpkt",
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


def check_python(exam: Examination) -> Iterator[Finding]:
    """Name Python, numpy and the machine; the drivers read 64-bit interfaces of Linux only."""
    n_bits = 8 * ctypes.sizeof(ctypes.c_void_p)
    yield findings.PYTHON(
        python=platform.python_version(),
        numpy=metadata.version("numpy"),
        system=platform.system(),
        machine=platform.machine(),
        n_bits=n_bits,
    )
    if sys.platform != "linux" or n_bits != 64:
        yield findings.NOT_LINUX_64()


def check_packages(exam: Examination) -> Iterator[Finding]:
    """Look for the packages, and for dv-processing where the rig has a DAVIS."""
    missing = tuple(name for module, name in _PACKAGES.items() if find_spec(module) is None)
    needs_davis = _uses_driver(exam.rig, "davis")
    if missing:
        yield findings.PACKAGES_MISSING(packages=missing)
    elif needs_davis and find_spec("dv_processing") is None:
        yield findings.DV_PROCESSING_MISSING()
    else:
        opencv, davis = _version("opencv-python-headless"), _version("dv-processing") if needs_davis else None
        yield findings.PACKAGES(n=len(_PACKAGES), opencv=opencv, dv_processing=davis)


def check_libraries(exam: Examination) -> Iterator[Finding]:
    """Try to load the system libraries that Open3D is linked with; only `simulate` needs it."""
    missing = []
    for library in _OPEN3D_LIBRARIES:
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(library)
    if missing:
        packages = tuple(_OPEN3D_LIBRARIES[name] for name in missing)
        yield findings.LIBRARIES_MISSING(libraries=tuple(missing), packages=packages)
    else:
        yield findings.LIBRARIES(libraries=tuple(_OPEN3D_LIBRARIES))


def check_disk(exam: Examination) -> Iterator[Finding]:
    """Measure the free space of a folder's disk, and how fast it takes data that are flushed to it."""
    folder = exam.folder.absolute()
    folder = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        free_mb = shutil.disk_usage(folder).free / _MB
        block = os.urandom(_PROBE_BLOCK_BYTES)  # disks that compress are not fooled
        n_bytes, start_s = 0, time.monotonic()
        with tempfile.TemporaryFile(dir=folder) as file:
            # Half a second at most, each block flushed as a capture's files are.
            while n_bytes < _PROBE_BYTES and time.monotonic() - start_s < _PROBE_S:
                file.write(block)
                file.flush()
                os.fsync(file.fileno())
                n_bytes += len(block)
        write_mbps = n_bytes / _MB / max(time.monotonic() - start_s, 1e-9)
    except OSError as error:
        yield findings.DISK_NOT_WRITABLE(folder=str(folder), cause=error.strerror)
        return
    yield findings.DISK(free_mb=free_mb, write_mbps=write_mbps, folder=str(folder))
    if free_mb < _SCARCE_MB:
        yield findings.DISK_FULL(severity="error" if free_mb < _MIN_FREE_MB else "warning")
    elif write_mbps < _SLOW_WRITE_MBPS:
        yield findings.DISK_SLOW(severity="error" if write_mbps < _MIN_WRITE_MBPS else "warning")


def check_socket_buffer(exam: Examination) -> Iterator[Finding]:
    """Ask the kernel for the receive buffer of a VLP-16's port, and see how much it grants."""
    if not _uses_driver(exam.rig, "vlp16"):
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        # Linux doubles what was asked for, for its own accounts, and reports the double.
        granted_bytes = port.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    buffer_s = granted_bytes / PACKET_COST_BYTES * velodyne.READ[0].packet_ns(False) * 1e-9
    figures: dict[str, Any] = {
        "buffer_s": buffer_s,
        "granted_kib": granted_bytes >> 11,
        "wanted_bytes": WANTED_BUFFER_BYTES,
    }
    yield findings.BUFFER(**figures)
    if buffer_s < _MIN_BUFFER_S:
        yield findings.BUFFER_SMALL(**figures)


def check_udev_rules(exam: Examination) -> Iterator[Finding]:
    """Look for udev rules of a DAVIS and of a sync board, which a user could not open without."""
    wanted = {_DAVIS_VENDOR: "DAVIS"} if _uses_driver(exam.rig, "davis") else {}
    if exam.rig.sync is not None:
        wanted[_TEENSY_VENDOR] = "sync board"
    if not wanted or not _UDEV.is_dir():  # in a container the host's rules count
        return
    files = [path for place in _UDEV_RULES if place.is_dir() for path in place.glob("*.rules")]
    rules = "".join(path.read_text(encoding="utf-8", errors="replace") for path in files)
    devices = tuple(device for vendor, device in wanted.items() if f'"{vendor}"' not in rules)
    if devices:
        shipped = str(resources.files("lce_rig") / "devices" / "60-lce-rig.rules")
        yield findings.UDEV_RULES_MISSING(devices=devices, rules=shipped)
    else:
        yield findings.UDEV_RULES(devices=tuple(wanted.values()))


def check_clock(exam: Examination) -> Iterator[Finding]:
    """Ask the kernel whether something keeps the computer's clock right; a VLP-16's hour is taken from it."""
    timex = (ctypes.c_long * _TIMEX_LONGS)()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    if state in (-1, _TIME_ERROR):
        yield findings.COMPUTER_CLOCK_LOOSE()
    else:
        yield findings.COMPUTER_CLOCK(max_error_ms=timex[_MAX_ERROR_LONG] / 1000)


def _uses_driver(rig: Rig, kind: str) -> bool:
    return any(driver_of(rig, sensor) == kind for sensor in sensors(rig))


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
