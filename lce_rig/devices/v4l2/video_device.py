"""One video device of the kernel: what it is, the form of its images, and its memory-mapped buffers."""

import errno
import os
import select
import stat
from contextlib import suppress
from ctypes import Structure, c_int32
from dataclasses import dataclass
from fcntl import ioctl
from mmap import MAP_SHARED, PROT_READ, PROT_WRITE, mmap
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.devices.v4l2 import abi

_US_NS = 1000
_S_NS = 1_000_000_000


@dataclass(frozen=True)
class Layout:
    """How a device lays its images out.

    Attributes:
        code: four characters of the pixel format.
        width, height: px.
        strides: bytes from row to row, of each plane that lies in memory of its own; 0 for compressed images.
    """

    code: str
    width: int
    height: int
    strides: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One image as the kernel hands it over.

    Attributes:
        planes: its bytes, of each plane that lies in memory of its own.
        stamp_ns: on the driver's clock.
        sequence: running number; gaps are lost images.
        flags: the kernel's, see `v4l2_abi`.
    """

    planes: tuple[bytes, ...]
    stamp_ns: int
    sequence: int
    flags: int

    @property
    def is_damaged(self) -> bool:
        """Whether the driver says that part of it is missing or wrong."""
        return bool(self.flags & abi.BUFFER_ERROR)


class VideoDevice:
    """An opened video device.

    Args:
        path: the device file.
        sensor: name of the camera, for messages.

    Raises:
        SourceError: it is absent, forbidden, or no camera.
    """

    def __init__(self, path: str, sensor: str) -> None:
        self.path = path
        self._sensor = sensor
        self._buffers: list[tuple[mmap, ...]] = []
        self._n_planes = 1
        self._kind = abi.VIDEO_CAPTURE
        self._fd = self._open()
        try:
            self._check_capabilities()
        except BaseException:
            self.close()
            raise

    def ioctl(self, code: int, what: Structure | c_int32) -> None:
        """Ask the kernel; the answer stands in `what`.

        Raises:
            OSError: as the kernel says.
        """
        ioctl(self._fd, code, what, True)

    def grants(self, code: int, what: Structure | c_int32) -> bool:
        """Ask the kernel for something that it may refuse; says whether it did not."""
        try:
            self.ioctl(code, what)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Stop, give the buffers back and close."""
        if self._fd >= 0:
            self.stop()
            os.close(self._fd)
            self._fd = -1

    def formats(self) -> list[str]:
        """List the pixel formats it offers, in its own order."""
        codes = []
        ask = abi.FormatDescription(type=self._kind)
        while self.grants(abi.ENUMERATE_FORMATS, ask):
            codes.append(ask.pixelformat.decode("ascii", "replace").ljust(4))
            ask.index += 1
        return codes

    def sizes(self, code: str) -> list[str]:
        """List the image sizes it offers in a pixel format, in words: "1280x720"."""
        found = []
        ask = abi.FrameSize(pixel_format=code.encode())
        while self.grants(abi.ENUMERATE_SIZES, ask):
            if ask.type != abi.DISCRETE_SIZES:
                return [f"any from {ask.sizes[0]}x{ask.sizes[3]} to {ask.sizes[1]}x{ask.sizes[4]}"]
            found.append(f"{ask.sizes[0]}x{ask.sizes[1]}")
            ask.index += 1
        return found

    def set_layout(self, code: str, width: int, height: int) -> Layout:
        """Ask for a form of images; gives what the device will deliver instead if it must.

        Raises:
            SourceError: another program streams from it.
        """
        ask = abi.Format(type=self._kind)
        pix = ask.fmt.pix_mp if self._has_planes else ask.fmt.pix
        pix.width, pix.height = width, height
        pix.pixelformat, pix.field = code.encode(), abi.FIELD_NONE
        try:
            self.ioctl(abi.SET_FORMAT, ask)
        except OSError as error:
            raise self._explain(error, "does not take an image format") from None
        if self._has_planes:
            self._n_planes = min(max(pix.num_planes, 1), abi.MAX_PLANES)
            strides = tuple(plane.bytesperline for plane in pix.plane_fmt[: self._n_planes])
        else:
            strides = (pix.bytesperline,)
        given = pix.pixelformat.decode("ascii", "replace").ljust(4)
        return Layout(given, pix.width, pix.height, strides)

    def set_rate(self, rate_hz: float) -> float | None:
        """Ask for images a second; gives what they will be, None where the device does not say."""
        ask = abi.CaptureParameters(type=self._kind, numerator=1000, denominator=round(1000 * rate_hz))
        if not self.grants(abi.SET_PARAMETERS, ask) or not ask.numerator:
            return None
        return float(ask.denominator / ask.numerator)

    def start(self, n_buffers: int) -> int:
        """Map buffers and start; gives how many buffers there are.

        Raises:
            SourceError: another program streams from it, or the device fails.
        """
        request = abi.BufferRequest(count=n_buffers, type=self._kind, memory=abi.MEMORY_MMAP)
        try:
            self.ioctl(abi.REQUEST_BUFFERS, request)
            for index in range(request.count):
                buffer = self._buffer(index)
                self.ioctl(abi.QUERY_BUFFER, buffer)
                self._buffers.append(self._map(buffer))
                self.ioctl(abi.QUEUE_BUFFER, buffer)
            self.ioctl(abi.STREAM_ON, c_int32(self._kind))
        except OSError as error:
            raise self._explain(error, "does not start") from None
        return int(request.count)

    def stop(self) -> None:
        """Stop and give the buffers back; never raises."""
        # A device that was pulled out answers nothing any more.
        self.grants(abi.STREAM_OFF, c_int32(self._kind))
        while self._buffers:
            for plane in self._buffers.pop():
                plane.close()
        request = abi.BufferRequest(count=0, type=self._kind, memory=abi.MEMORY_MMAP)
        self.grants(abi.REQUEST_BUFFERS, request)

    def read(self, timeout_s: float) -> RawFrame | None:
        """Wait for an image; None where none came in time.

        Raises:
            SourceError: the device is gone.
            OSError: it failed this once (EIO).
        """
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        if not poll.poll(1000 * timeout_s):
            return None
        buffer = self._buffer(0)
        try:
            self.ioctl(abi.DEQUEUE_BUFFER, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            if error.errno == errno.EIO and Path(self.path).exists():
                raise
            raise self._explain(error, "stopped") from None
        planes = self._copy(buffer)
        stamp_ns = buffer.timestamp.seconds * _S_NS + buffer.timestamp.microseconds * _US_NS
        frame = RawFrame(planes, stamp_ns, buffer.sequence, buffer.flags)
        try:
            self.ioctl(abi.QUEUE_BUFFER, self._buffer(buffer.index))
        except OSError as error:
            raise self._explain(error, "stopped") from None
        return frame

    @property
    def _has_planes(self) -> bool:
        return self._kind == abi.VIDEO_CAPTURE_MPLANE

    def _buffer(self, index: int) -> abi.Buffer:
        buffer = abi.Buffer(index=index, type=self._kind, memory=abi.MEMORY_MMAP)
        if self._has_planes:
            buffer.m.planes = (abi.Plane * abi.MAX_PLANES)()  # The pointer keeps them alive.
            buffer.length = self._n_planes
        return buffer

    def _map(self, buffer: abi.Buffer) -> tuple[mmap, ...]:
        """Map the memory of a buffer, plane by plane."""
        if self._has_planes:
            places = [(plane.length, plane.m.mem_offset) for plane in buffer.m.planes[: self._n_planes]]
        else:
            places = [(buffer.length, buffer.m.offset)]
        return tuple(
            mmap(self._fd, length, MAP_SHARED, PROT_READ | PROT_WRITE, offset=offset)
            for length, offset in places
        )

    def _copy(self, buffer: abi.Buffer) -> tuple[bytes, ...]:
        """Copy the image in a buffer that the kernel has just handed over."""
        memory = self._buffers[buffer.index]
        if not self._has_planes:
            return (memory[0][: buffer.bytesused or buffer.length],)
        filled = buffer.m.planes[: self._n_planes]
        return tuple(
            mapped[plane.data_offset : plane.bytesused or plane.length]
            for mapped, plane in zip(memory, filled, strict=True)
        )

    def _open(self) -> int:
        try:
            if not stat.S_ISCHR(Path(self.path).stat().st_mode):
                raise SourceError(f"camera {self._sensor!r}: {self.path} is no device file", _attached())
            return os.open(self.path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise self._explain(error, "cannot be opened") from None

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
        if not able & (abi.CAP_VIDEO_CAPTURE | abi.CAP_VIDEO_CAPTURE_MPLANE) or not able & abi.CAP_STREAMING:
            raise SourceError(f"{where} delivers no images; it is another end of some device", _attached())
        # Image processors of many boards (Rockchip, Qualcomm, NXP) deliver planes only.
        self._kind = abi.VIDEO_CAPTURE if able & abi.CAP_VIDEO_CAPTURE else abi.VIDEO_CAPTURE_MPLANE

    def _explain(self, error: OSError, what: str) -> SourceError:
        """Say what a failure of the device means and what to check."""
        where = f"camera {self._sensor!r}: {self.path}"
        if error.errno in (errno.ENODEV, errno.ENXIO) or not Path(self.path).exists():
            if self._buffers:
                hint = "Was it unplugged? Check cable and power, `dmesg | tail`; then start again."
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


def video_devices() -> list[str]:
    """Name the video devices of this computer: "/dev/video0 (vivid)"."""
    found = []
    for path in sorted(Path("/dev").glob("video*"), key=lambda path: (len(path.name), path.name)):
        name = Path("/sys/class/video4linux") / path.name / "name"
        found.append(f"{path} ({name.read_text().strip()})" if name.exists() else str(path))
    return found


def serial_number(name: str, system: Path = Path("/sys/class/video4linux")) -> str:
    """Give the serial number of the USB device behind a video device; "" where the kernel knows none.

    Args:
        name: of the video device: "video0".
        system: where the kernel lists video devices.
    """
    try:
        device = (system / name / "device").resolve(strict=True)
    except (OSError, RuntimeError):
        return ""
    # The interface of a USB device lies in the device's folder, whose `serial` is its own.
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
