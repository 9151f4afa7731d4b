"""A V4L2 device: image format, memory-mapped buffers, and controls.

Settings have the names that v4l2-ctl shows; they are set from the profile, read back, and compared.
"""

import errno
import os
import re
import select
import stat
from collections.abc import Mapping
from contextlib import suppress
from ctypes import Structure, c_int32, pointer
from fcntl import ioctl
from mmap import MAP_SHARED, PROT_READ, PROT_WRITE, mmap
from pathlib import Path
from typing import Any

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices import v4l2_abi as abi

Value = bool | int | float | str
Control = tuple[int, int]
"""Number of a setting, and its kind as in `v4l2_abi`."""
_NUMBERS = (abi.INTEGER, abi.BOOLEAN, abi.MENU, abi.INTEGER64, abi.BITMASK, abi.INTEGER_MENU)
_EXPOSURE_UNIT_US = 100
_LIST_CONTROLS = "`v4l2-ctl --list-ctrls-menus` lists the settings and their numbers."
_LOCKED = f"An automatic mode or a running stream may lock it: set that mode, too. {_LIST_CONTROLS}"


class VideoDevice:
    """An opened video device.

    Args:
        path: the device file.
        sensor: name of the camera, for messages.

    Raises:
        SourceError: the device is absent, not accessible to this user, or not a camera.
    """

    def __init__(self, path: str, sensor: str) -> None:
        self.path = path
        self._sensor = sensor
        self._buffers: list[mmap] = []
        try:
            if not stat.S_ISCHR(Path(path).stat().st_mode):
                raise SourceError(f"camera {sensor!r}: {path} is not a device file", _attached())
            self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise self._explain(error, "cannot be opened") from None
        try:
            self._check_capabilities()
        except BaseException:
            self.close()
            raise

    def ioctl(self, code: int, what: Structure | c_int32) -> None:
        """Call the kernel, which writes its reply to the structure.

        Raises:
            OSError: from the kernel.
        """
        ioctl(self._fd, code, what, True)

    def grants(self, code: int, what: Structure | c_int32) -> bool:
        """Make a request that the kernel may refuse; return whether it succeeded."""
        try:
            self.ioctl(code, what)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Stop, release the buffers and close."""
        if self._fd >= 0:
            self.stop()
            os.close(self._fd)
            self._fd = -1

    def formats(self) -> list[str]:
        """List the pixel formats of the device, in its own order."""
        codes = []
        ask = abi.FormatDescription(type=abi.VIDEO_CAPTURE)
        while self.grants(abi.ENUMERATE_FORMATS, ask):
            codes.append(ask.pixelformat.decode("ascii", "replace").ljust(4))
            ask.index += 1
        return codes

    def set_layout(self, code: str, width: int, height: int) -> tuple[tuple[str, int, int], int]:
        """Request a pixel format and size of images.

        Returns:
            The pixel format and size, px, that will be delivered, and the bytes from row to row.

        Raises:
            SourceError: another program streams from it.
        """
        ask = abi.Format(type=abi.VIDEO_CAPTURE)
        pix = ask.fmt.pix
        pix.width, pix.height = width, height
        pix.pixelformat, pix.field = code.encode(), abi.FIELD_NONE
        try:
            self.ioctl(abi.SET_FORMAT, ask)
        except OSError as error:
            raise self._explain(error, "does not take an image format") from None
        granted = pix.pixelformat.decode("ascii", "replace").ljust(4)
        return (granted, pix.width, pix.height), pix.bytesperline

    def set_rate(self, rate_hz: float) -> None:
        """Request a rate of images, Hz; the device may choose another."""
        ask = abi.CaptureParameters(type=abi.VIDEO_CAPTURE, numerator=1000, denominator=round(1000 * rate_hz))
        self.grants(abi.SET_PARAMETERS, ask)

    def start(self, n_buffers: int) -> None:
        """Map buffers and start; the device may grant fewer.

        Raises:
            SourceError: another program streams from it, or the device fails.
        """
        request = abi.BufferRequest(count=n_buffers, type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        try:
            self.ioctl(abi.REQUEST_BUFFERS, request)
            for index in range(request.count):
                buffer = _buffer(index)
                self.ioctl(abi.QUERY_BUFFER, buffer)
                protection = PROT_READ | PROT_WRITE
                memory = mmap(self._fd, buffer.length, MAP_SHARED, protection, offset=buffer.m.offset)
                self._buffers.append(memory)
                self.ioctl(abi.QUEUE_BUFFER, buffer)
            self.ioctl(abi.STREAM_ON, c_int32(abi.VIDEO_CAPTURE))
        except OSError as error:
            raise self._explain(error, "does not start") from None

    def stop(self) -> None:
        """Stop and release the buffers; never raises."""
        # An unplugged device does not answer.
        self.grants(abi.STREAM_OFF, c_int32(abi.VIDEO_CAPTURE))
        while self._buffers:
            self._buffers.pop().close()
        request = abi.BufferRequest(count=0, type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        self.grants(abi.REQUEST_BUFFERS, request)

    def read(self, timeout_s: float) -> tuple[bytes, Any] | None:
        """Wait for an image; return its bytes and the kernel's `v4l2_abi.Buffer`, None on timeout.

        Raises:
            SourceError: the device is gone.
            OSError: this one image failed (EIO).
        """
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        if not poll.poll(1000 * timeout_s):
            return None
        buffer = _buffer(0)
        try:
            self.ioctl(abi.DEQUEUE_BUFFER, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            if error.errno == errno.EIO and Path(self.path).exists():
                raise
            raise self._explain(error, "stopped") from None
        data = self._buffers[buffer.index][: buffer.bytesused or buffer.length]
        try:
            self.ioctl(abi.QUEUE_BUFFER, _buffer(buffer.index))
        except OSError as error:
            raise self._explain(error, "stopped") from None
        return data, buffer

    def _check_capabilities(self) -> None:
        said = abi.Capability()
        try:
            self.ioctl(abi.QUERY_CAPABILITY, said)
        except OSError:
            what = f"camera {self._sensor!r}: {self.path} is no video device"
            raise SourceError(what, _attached()) from None
        self.card = said.card.decode("utf-8", "replace")
        self.driver = said.driver.decode("utf-8", "replace")
        self.bus = said.bus_info.decode("utf-8", "replace")
        able = said.device_caps if said.capabilities & abi.CAP_DEVICE_CAPS else said.capabilities
        where = f"camera {self._sensor!r}: {self.path} ({self.card})"
        if not able & abi.CAP_VIDEO_CAPTURE or not able & abi.CAP_STREAMING:
            # Image processors of many boards (Rockchip, Qualcomm, NXP) deliver several planes.
            hint = f"{_attached()} For several planes: driver.type command, with gst-launch-1.0 v4l2src."
            raise SourceError(f"{where} delivers no images, or in several planes", hint)

    def _explain(self, error: OSError, what: str) -> SourceError:
        """Explain a failure of the device, with an action."""
        where = f"camera {self._sensor!r}: {self.path}"
        if error.errno in (errno.ENODEV, errno.ENXIO) or not Path(self.path).exists():
            if self._buffers:
                hint = "Check cable and power, `dmesg | tail`; then start again."
                return SourceError(f"{where} is gone", hint)
            return SourceError(f"{where} is not there", _attached())
        if error.errno in (errno.EACCES, errno.EPERM):
            hint = "Add yourself to the group of the device: sudo usermod -aG video $USER, then log in again."
            return SourceError(f"{where} may not be opened by you", hint)
        if error.errno == errno.EBUSY:
            return SourceError(
                f"{where} is busy", f"Another program reads it: fuser -v {self.path} names it."
            )
        return SourceError(f"{where} {what}: {error.strerror}", "Check `dmesg | tail` and the cable.")


def _buffer(index: int) -> abi.Buffer:
    return abi.Buffer(index=index, type=abi.VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)


def video_devices() -> list[str]:
    """List the video devices of this computer: "/dev/video0 (vivid)"."""
    devices = []
    for path in sorted(Path("/dev").glob("video*"), key=lambda path: (len(path.name), path.name)):
        name = Path("/sys/class/video4linux") / path.name / "name"
        devices.append(f"{path} ({name.read_text().strip()})" if name.exists() else str(path))
    return devices


def serial_number(name: str, system: Path = Path("/sys/class/video4linux")) -> str:
    """Return the serial number of the USB device behind a video device; "" if unknown.

    Args:
        name: name of the video device: "video0".
        system: where the kernel lists video devices.
    """
    try:
        device = (system / name / "device").resolve(strict=True)
    except (OSError, RuntimeError):
        return ""
    # The USB interface is a subfolder of its device, which holds the `serial`.
    for folder in (device, device.parent):
        if (folder / "idVendor").exists() and (folder / "serial").exists():
            with suppress(OSError, UnicodeDecodeError):
                return (folder / "serial").read_text().strip()
    return ""


def _attached() -> str:
    devices = video_devices()
    if not devices:
        return "This computer has no video device: check the camera's cable, power and kernel driver (dmesg)."
    return f"Set driver.device to one of: {', '.join(devices)}."


def list_controls(device: VideoDevice) -> dict[str, Control]:
    """List the numeric controls, by their names in v4l2-ctl."""
    controls = {}
    ask = abi.ControlQuery(id=abi.NEXT_CONTROL)
    while device.grants(abi.QUERY_CONTROL, ask):
        if ask.type in _NUMBERS and not ask.flags & abi.CONTROL_DISABLED and ask.nr_of_dims == 0:
            # "Exposure Time, Absolute" is exposure_time_absolute.
            name = re.sub(r"[^a-z0-9]+", "_", ask.name.decode("utf-8", "replace").lower()).strip("_")
            controls[name] = ask.id, ask.type
        ask.id |= abi.NEXT_CONTROL
    return controls


def apply_controls(device: VideoDevice, sensor: str, wanted: Mapping[str, Value]) -> list[Finding]:
    """Apply the profile's controls: choices first, since automatic modes lock other settings.

    Returns:
        Deviations from the requested values: the device clips numbers to its range.

    Raises:
        SourceError: the device lacks the setting, or cannot take the value.
    """
    known = list_controls(device)
    where = f"camera {sensor!r}: driver.controls"
    for name, value in wanted.items():
        if name not in known:
            hint = f"It has: {', '.join(sorted(known)) or 'none'}."
            raise SourceError(f"{where}.{name}: {device.card} has no such setting", hint)
        if isinstance(value, str) or value != int(value):
            raise SourceError(f"{where}.{name}: {value!r} is not a whole number", _LIST_CONTROLS)
    deviations = []
    for name in sorted(wanted, key=lambda name: known[name][1] in (abi.INTEGER, abi.INTEGER64)):
        (number, kind), value = known[name], int(wanted[name])
        control = abi.V4l2Control(id=number)
        setattr(control.value, "value64" if kind == abi.INTEGER64 else "value", value)
        try:
            device.ioctl(abi.SET_CONTROLS, abi.V4l2Controls(count=1, controls=pointer(control)))
        except OSError as error:
            raise SourceError(f"{where}.{name}: {value} is refused: {error.strerror}", _LOCKED) from None
        given = read_control(device, known[name])
        if given is not None and given != value:
            deviations.append(findings.CONTROL_DIFFERS(control=name, given=given, expected=value))
    return deviations


def read_control(device: VideoDevice, setting: Control) -> int | None:
    """Read one setting; None if the device does not report it."""
    number, kind = setting
    control = abi.V4l2Control(id=number)
    if not device.grants(abi.GET_CONTROLS, abi.V4l2Controls(count=1, controls=pointer(control))):
        return None
    return int(control.value.value64 if kind == abi.INTEGER64 else control.value.value)


def read_exposure_us(device: VideoDevice, known: Mapping[str, Control]) -> float | None:
    """Return the exposure time of a row, us; None without a control in a known unit.

    V4L2_CID_EXPOSURE counts in units of the driver's choice; Jetson's 64-bit setting of that name in us.
    """
    for name, (number, kind) in known.items():
        is_jetsons = name == "exposure" and kind == abi.INTEGER64
        if is_jetsons or number == abi.EXPOSURE_ABSOLUTE_ID:
            value = read_control(device, (number, kind))
            return None if value is None else float(value * (1 if is_jetsons else _EXPOSURE_UNIT_US))
    return None
