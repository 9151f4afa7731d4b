"""Images from a command's standard output: GStreamer, ffmpeg or any program that writes them.

They come one behind the other: Y4M, JPEG, or raw.

References:
    https://wiki.multimedia.cx/index.php/YUV4MPEG2
    ITU-T T.81, annex B (the segments of a JPEG)
"""

import os
import selectors
import signal
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from fcntl import F_SETPIPE_SZ, fcntl
from typing import IO

from lce_rig.core.data import Image, LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.devices import findings
from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, Pixels, find_format
from lce_rig.devices.reading import ClockState, LiveSource, SourceStatus
from lce_rig.io.decoding import decode_image
from lce_rig.rig import CameraSettings
from lce_rig.rig.sensors import MAX_PIXELS

_WAIT_S = 0.25
_PATIENCE_S = 2.0
_PIPE_BYTES = 1 << 20
_N_BEGIN = 16
_TAIL_BYTES = 2000
_MAX_HEADER = 4096
_MAX_JPEG = 1 << 26
# They differ in where a chroma sample sits.
_Y4M_COLOURS = ("mono", "420", "420jpeg", "420mpeg2", "420paldv")
_SOI, _EOI, _SOS = b"\xff\xd8", b"\xff\xd9", 0xDA
_EXAMPLE = (
    "gst-launch-1.0 -q v4l2src device=/dev/video0 ! videoconvert ! video/x-raw,format=I420 ! y4menc ! fdsink"
)


class ImagePipeSource(LiveSource):
    """A camera read by a command of the profile; see `LiveSource`.

    The command writes Y4M or JPEG images, one behind the other, or raw ones of a pixel_format.
    Such a stream carries no usable timestamps: those given are the arrival of an image's last byte
    as it is, and the status says so.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        silence_s: so long without an image is an error.
    """

    def __init__(self, sensor: str, settings: CameraSettings, silence_s: float = 10.0) -> None:
        hint = f"Run its command in a shell: does it write images? {' '.join(settings.driver.command)}"
        super().__init__(sensor, f"camera {sensor!r}", silence_s, hint)
        self._settings = settings
        self._channel = settings.first_channel("frames") or "frames"
        self._stack = ExitStack()
        self._stream: ImageStream | None = None
        self._begin = b""
        self._complaints = b""
        self._n_images = self._n_damaged_before = 0

    def open(self) -> None:
        """Start the command.

        Raises:
            SourceError: there is none, or it cannot be started.
        """
        command = self._settings.driver.command
        if not command:
            line = "driver: {type: command, command: [PROGRAM, ARGUMENT, ...]}"
            hint = f"Add to cameras.{self.sensor}: {line}\nAn example of a command: {_EXAMPLE}"
            raise SourceError(f"{self.sensor}: the profile does not say how it is reached", hint)
        self._n_damaged_before += self._stream.n_damaged if self._stream else 0
        self._begin, self._complaints, self._n_images = b"", b"", 0
        # Raw images where the profile names their format; else their first bytes tell.
        self._stream = None
        wanted = self._settings.driver.pixel_format
        if wanted is not None:
            code = find_format(wanted)
            if code is None:
                what = f"{self._who}: driver.pixel_format {wanted!r} is not read here"
                known = ", ".join(code.strip() for code in FORMATS)
                raise SourceError(what, f"It can be {known}, or missing for Y4M and JPEG.")
            size = self._settings.resolution_px
            self._stream = JpegImages() if FORMATS[code].is_compressed else RawImages(code, *size)
        with ExitStack() as stack:
            try:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    bufsize=0,
                    start_new_session=True,  # Ctrl-C is ours; the command is stopped in its turn
                )
            except OSError as error:
                hint = "Is the program installed? Give its full path."
                what = f"{self._who}: {command[0]} cannot be started: {error.strerror}"
                raise SourceError(what, hint) from None
            stack.callback(_end_process, self._process)
            self._selector = stack.enter_context(selectors.DefaultSelector())
            for pipe in self._pipes():
                os.set_blocking(pipe.fileno(), False)
                self._selector.register(pipe, selectors.EVENT_READ)
            with suppress(OSError):  # fewer, larger reads where the system allows
                fcntl(self._pipes()[0].fileno(), F_SETPIPE_SZ, _PIPE_BYTES)
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Stop the command."""
        self._stack.close()

    def describe(self) -> SourceStatus:
        """Report the state of the camera."""
        n_damaged = self._n_damaged_before + (self._stream.n_damaged if self._stream else 0)
        problems = []
        if n_damaged:
            problems.append(findings.DAMAGED_IMAGES(n=n_damaged, action="command"))
        return SourceStatus(
            self.sensor,
            n_lost=n_damaged,
            clock=ClockState(findings.ARRIVAL()),
            problems=tuple(problems),
            device=" ".join(self._settings.driver.command),
        )

    def _pipes(self) -> tuple[IO[bytes], IO[bytes]]:
        assert self._process.stdout is not None and self._process.stderr is not None  # both are pipes
        return self._process.stdout, self._process.stderr

    def read(self) -> list[LiveSample]:
        """Return the images that came; see `LiveSource`."""
        pictures, complaints = self._pipes()
        samples: list[LiveSample] = []
        for key, _ in self._selector.select(_WAIT_S):
            data = os.read(key.fd, _PIPE_BYTES)
            if key.fileobj is complaints:
                self._complaints = (self._complaints + data)[-_TAIL_BYTES:]
                if not data:
                    self._selector.unregister(complaints)
            elif data:
                samples += self._to_images(data)
            else:
                self._raise_end(pictures)
        return samples

    def _to_images(self, data: bytes) -> Iterator[Image]:
        if len(self._begin) < _N_BEGIN:
            self._begin = data = self._begin + data
            if len(data) < _N_BEGIN:
                return
        if self._stream is None:
            self._stream = find_stream(self._begin)
            if self._stream is None:
                begin = self._begin[:16]
                what = f"{self._who}: its command writes no Y4M or JPEG; it begins {begin!r}"
                raise SourceError(what, f"For raw images set driver.pixel_format. An example: {_EXAMPLE}")
        try:
            for pixels in self._stream.feed(data):
                host_ns = time.time_ns()
                size, wanted = pixels.shape[1::-1], self._settings.resolution_px
                if size != wanted:
                    raise SourceError(
                        f"{self._who}: its command writes {size[0]}x{size[1]} px, the intrinsics belong to "
                        f"{wanted[0]}x{wanted[1]} px",
                        "Set the size in the command, or measure intrinsics at this size.",
                    )
                count = self._n_images + self._stream.n_damaged
                self._n_images += 1
                yield Image(self.sensor, self._channel, host_ns, pixels, host_ns, count)
        except ValueError as error:
            raise SourceError(f"{self._who}: its command's images: {error}", self._complaint()) from None

    def _raise_end(self, pictures: IO[bytes]) -> None:
        """Report the end of the command.

        Raises:
            SourceError: always.
        """
        self._selector.unregister(pictures)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE_S)
        with suppress(OSError):
            self._complaints = (self._complaints + os.read(self._pipes()[1].fileno(), 1 << 16))[-_TAIL_BYTES:]
        code = self._process.returncode
        how = "closed its output" if code is None else f"ended with exit code {code}"
        if code is not None and code < 0:
            how = f"was ended by {signal.Signals(-code).name}"
        raise SourceError(f"{self._who}: its command {how} after {self._n_images} images", self._complaint())

    def _complaint(self) -> str:
        lines = self._complaints.decode("utf-8", "replace").strip().splitlines()[-3:]
        if lines:
            return f"It said: {' | '.join(line.strip() for line in lines)}"
        return f"Run it in a shell: {' '.join(self._settings.driver.command)}"


def _end_process(process: "subprocess.Popen[bytes]") -> None:
    """Stop the command and all it has started, by force if need be."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
            break
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


class ImageStream(ABC):
    """Bytes in as they come, images out.

    Attributes:
        n_damaged: images that were there and could not be decoded.
    """

    def __init__(self, decode: Callable[[bytes], Pixels] = decode_image) -> None:
        self.n_damaged = 0
        self._decode = decode
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[Pixels]:
        """Take bytes and yield the images that they complete, (H, W) grey or (H, W, 3) BGR.

        Raises:
            ValueError: the stream is not what it began as.
        """
        self._rest += data
        while (payload := self._cut()) is not None:
            try:
                pixels = self._decode(payload)
            except ValueError:
                self.n_damaged += 1
                continue
            yield pixels

    @abstractmethod
    def _cut(self) -> bytes | None:
        """Take the next image's bytes off the rest; None where they have not all come."""

    def _take(self, n_bytes: int) -> bytes | None:
        if len(self._rest) < n_bytes:
            return None
        taken = bytes(self._rest[:n_bytes])
        del self._rest[:n_bytes]
        return taken


class RawImages(ImageStream):
    """Images of one pixel format and size, with nothing between them and no padding of rows."""

    def __init__(self, code: str, width: int, height: int) -> None:
        decoder = PixelDecoder(code, width, height)
        super().__init__(decoder.decode)
        self._n_bytes = decoder.n_bytes

    def _cut(self) -> bytes | None:
        return self._take(self._n_bytes)


class Y4mImages(ImageStream):
    """YUV4MPEG2 of 8 bits, grey or 4:2:0."""

    def __init__(self) -> None:
        super().__init__()
        self._n_bytes = 0
        self._is_in_frame = False

    def _cut(self) -> bytes | None:
        if not self._n_bytes:
            header = self._line()
            if header is None:
                return None
            self._read_header(header)
        if not self._is_in_frame:
            line = self._line()
            if line is None:
                return None
            if not line.startswith("FRAME"):
                raise ValueError(f"a Y4M frame was expected, {line[:20]!r} came (GStreamer: use jpegenc)")
            self._is_in_frame = True
        payload = self._take(self._n_bytes)
        self._is_in_frame = payload is None
        return payload

    def _line(self) -> str | None:
        end = self._rest.find(b"\n", 0, _MAX_HEADER)
        if end < 0 and len(self._rest) >= _MAX_HEADER:
            raise ValueError("a line of text was expected, other bytes came")
        line = self._take(end + 1) if end >= 0 else None
        return None if line is None else line.decode("ascii", "backslashreplace").rstrip()

    def _read_header(self, line: str) -> None:
        fields = {word[0]: word[1:] for word in line.split(" ")[1:] if word}
        sides, colour = (fields.get("W", ""), fields.get("H", "")), fields.get("C", "420")
        if not all(side.isdigit() and 0 < int(side) < 65536 for side in sides):
            raise ValueError(f"the Y4M header holds no size: {line[:80]!r}")
        if colour not in _Y4M_COLOURS:
            raise ValueError(f"Y4M colour {colour} is not read here: let the command write 4:2:0, 8 bit")
        width, height = (int(side) for side in sides)
        if width * height > MAX_PIXELS:
            raise ValueError(f"Y4M images of {width}x{height} px are too large: at most {MAX_PIXELS} px")
        if colour != "mono" and (width % 2 or height % 2):
            raise ValueError(f"Y4M images of {width}x{height} px in colour: both must be even")
        decoder = PixelDecoder("GREY" if colour == "mono" else "YU12", width, height)
        self._n_bytes, self._decode = decoder.n_bytes, decoder.decode


class JpegImages(ImageStream):
    """JPEG files, one behind the other; anything between them is skipped."""

    def __init__(self) -> None:
        super().__init__()
        self._searched = 0

    def _cut(self) -> bytes | None:
        start = self._rest.find(_SOI + b"\xff")
        if start < 0:
            del self._rest[: max(0, len(self._rest) - 2)]
            return None
        if start:
            del self._rest[:start]
            self._searched = 0
        end = self._find_end()
        if end is None:
            if len(self._rest) > _MAX_JPEG:
                raise ValueError(f"a JPEG image does not end within {_MAX_JPEG >> 20} MiB")
            return None
        self._searched = 0
        return self._take(end)

    def _find_end(self) -> int | None:
        """Walk the segments, which may hold small images, to the data, which ends at the first EOI."""
        at = 2
        while at + 4 <= len(self._rest) and self._rest[at] == 0xFF:
            kind, n_bytes = self._rest[at + 1], int.from_bytes(self._rest[at + 2 : at + 4], "big")
            at += 2 + n_bytes
            if kind == _SOS:
                found = self._rest.find(_EOI, max(at, self._searched - 1))
                self._searched = len(self._rest)
                return None if found < 0 else found + 2
        if at + 4 <= len(self._rest):  # damaged: go on at the next image
            following = self._rest.find(_SOI + b"\xff", 2)
            return following if following > 0 else None
        return None


def find_stream(begin: bytes) -> ImageStream | None:
    """Choose the kind of a stream by its first bytes; None where they fit none."""
    if begin.startswith(b"YUV4MPEG2 "):
        return Y4mImages()
    if begin.startswith(_SOI) or begin.startswith(b"--"):  # "--": the boundary of a multipart stream
        return JpegImages()
    return None
