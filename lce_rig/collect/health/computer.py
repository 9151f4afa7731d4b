"""The computer itself: Python and its packages, system libraries, disk, network buffer and clock."""

import ctypes
import os
import platform
import shutil
import socket
import sys
import tempfile
import time
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from lce_rig.collect.health.check import Check, Severity
from lce_rig.collect.health.sensors import uses_driver
from lce_rig.core import velodyne
from lce_rig.rig import Rig
from lce_rig.sources.live.vlp16_socket import PACKET_COST_BYTES, WANTED_BUFFER_BYTES

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
_MIN_BUFFER_S = 0.25
_PROBE_BYTES, _PROBE_BLOCK_BYTES, _PROBE_S = 48 << 20, 4 << 20, 0.5
_MB = 1e6
# A capture is a few MB; raw pictures of 1280x720 px at 30 Hz are 55 MB/s.
_MIN_FREE_MB, _SCARCE_MB = 500.0, 5000.0
_MIN_WRITE_MBPS, _SLOW_WRITE_MBPS = 2.0, 20.0
# struct timex is 26 longs on 64-bit Linux; its fourth is the largest error, us.
_TIMEX_LONGS, _MAX_ERROR_LONG, _TIME_ERROR = 32, 3, 5


def check_python(rig: Rig, folder: Path) -> Check:
    """Name Python, numpy and the machine; the drivers read 64-bit interfaces of Linux only."""
    n_bits = 8 * ctypes.sizeof(ctypes.c_void_p)
    figure = (
        f"Python {platform.python_version()}, numpy {metadata.version('numpy')}, "
        f"{platform.system()} {platform.machine()}, {n_bits} bit"
    )
    if sys.platform != "linux" or n_bits != 64:
        remedy = "Live sensors are read on 64-bit Linux only; recordings are read here too."
        return Check(_GROUP, "python", "red", figure, remedy)
    return Check(_GROUP, "python", "green", figure)


def check_packages(rig: Rig, folder: Path) -> Check:
    """Look for the packages, and for dv-processing where the rig has a DAVIS."""
    missing = [name for module, name in _PACKAGES.items() if find_spec(module) is None]
    if missing:
        remedy = f"Run: pip install {' '.join(missing)}"
        return Check(_GROUP, "packages", "red", f"missing: {', '.join(missing)}", remedy)
    n_found, davis = len(_PACKAGES), ""
    if uses_driver(rig, "davis"):
        if find_spec("dv_processing") is None:
            remedy = "Run: pip install 'lce-rig[davis]' (Linux, Python 3.10 to 3.13)"
            return Check(_GROUP, "packages", "red", "missing: dv-processing, which reads the DAVIS", remedy)
        davis = f", dv-processing {metadata.version('dv-processing')}"
    opencv = metadata.version("opencv-python-headless") if _has("opencv-python-headless") else "another build"
    return Check(_GROUP, "packages", "green", f"all {n_found} installed; OpenCV {opencv}{davis}")


def check_libraries(rig: Rig, folder: Path) -> Check:
    """Try to load the system libraries that Open3D is linked with; only `simulate` needs it."""
    missing = [name for name in _OPEN3D_LIBRARIES if not _loads(name)]
    if missing:
        packages = " ".join(_OPEN3D_LIBRARIES[name] for name in missing)
        figure = f"missing: {', '.join(missing)}; Open3D, which `lce-rig simulate` uses, does not load"
        return Check(_GROUP, "libraries", "yellow", figure, f"Run: sudo apt install {packages}")
    found = ", ".join(name.partition(".so")[0] for name in _OPEN3D_LIBRARIES)
    return Check(_GROUP, "libraries", "green", found)


def check_disk(rig: Rig, folder: Path) -> Check:
    """Measure the free space of a folder's disk, and how fast it takes data that are flushed to it."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        free_mb = shutil.disk_usage(there).free / _MB
        speed_mbps = _write_speed_mbps(there)
    except OSError as error:
        figure = f"{there} cannot be written: {error.strerror}"
        return Check(_GROUP, "disk", "red", figure, "Choose another folder with -o, or make room there.")
    figure = f"{free_mb / 1000:.1f} GB free, {speed_mbps:.0f} MB/s flushed, in {there}"
    values = {"free_mb": free_mb, "write_mbps": speed_mbps}
    if free_mb < _SCARCE_MB:
        severity: Severity = "red" if free_mb < _MIN_FREE_MB else "yellow"
        return Check(_GROUP, "disk", severity, figure, "Make room, or choose another disk with -o.", values)
    if speed_mbps < _SLOW_WRITE_MBPS:
        severity = "red" if speed_mbps < _MIN_WRITE_MBPS else "yellow"
        remedy = "Write to an SSD (-o FOLDER), and record no raw streams beside the captures."
        return Check(_GROUP, "disk", severity, figure, remedy, values)
    return Check(_GROUP, "disk", "green", figure, values=values)


def check_socket_buffer(rig: Rig, folder: Path) -> Check | None:
    """Ask the kernel for the receive buffer of a VLP-16's port, and see how much it grants."""
    if not uses_driver(rig, "vlp16"):
        return None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        # Linux doubles what was asked for, for its own accounts, and reports the double.
        granted_bytes = port.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    buffer_s = granted_bytes / PACKET_COST_BYTES * velodyne.packet_ns(False) * 1e-9
    figure = f"{granted_bytes >> 11} KiB granted: {buffer_s:.2f} s of a VLP-16's packets"
    values = {"granted_bytes": float(granted_bytes), "buffer_s": buffer_s}
    if buffer_s < _MIN_BUFFER_S:
        remedy = (
            f"Run: sudo sysctl -w net.core.rmem_max={WANTED_BUFFER_BYTES}\n"
            f"To keep it: echo net.core.rmem_max={WANTED_BUFFER_BYTES} | sudo tee /etc/sysctl.d/60-lidar.conf"
        )
        return Check(_GROUP, "buffer", "yellow", figure, remedy, values)
    return Check(_GROUP, "buffer", "green", figure, values=values)


def check_clock(rig: Rig, folder: Path) -> Check:
    """Ask the kernel whether something keeps the computer's clock right; a VLP-16's hour is taken from it."""
    timex = (ctypes.c_long * _TIMEX_LONGS)()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    error_ms = timex[_MAX_ERROR_LONG] / 1000
    if state in (-1, _TIME_ERROR):
        remedy = "Run: timedatectl set-ntp true, or let chrony follow the rig's GPS."
        return Check(_GROUP, "clock", "yellow", "not synchronised, says the kernel", remedy)
    figure = f"synchronised, off by {error_ms:.0f} ms at most"
    return Check(_GROUP, "clock", "green", figure, values={"max_error_ms": error_ms})


COMPUTER_CHECKS = (
    check_python,
    check_packages,
    check_libraries,
    check_disk,
    check_socket_buffer,
    check_clock,
)
"""Every check of the computer: each takes the rig and the folder of sessions; None where there is no need."""


def _has(distribution: str) -> bool:
    try:
        metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


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
