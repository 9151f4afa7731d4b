"""Images from a command's standard output: GStreamer, ffmpeg or any program that writes them.

They come one behind the other: Y4M, or raw.

References:
    https://wiki.multimedia.cx/index.php/YUV4MPEG2
"""

import os
import selectors
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from fcntl import F_SETPIPE_SZ, fcntl
from typing import IO

from lce_rig.core.data import Image, LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.devices import findings
from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, Pixels, find_format
from lce_rig.devices.reading import LiveSource, SourceStatus
from lce_rig.rig import CameraSettings
from lce_rig.rig.sensors import MAX_PIXELS

_WAIT_S = 0.25
_PATIENCE_S = 2.0
_PIPE_BYTES = 1 << 20
_TAIL_BYTES = 2000
_MAX_HEADER = 4096
_Y4M = b"YUV4MPEG2 "
# They differ in where a chroma sample sits.
_Y4M_COLOURS = ("mono", "420", "420jpeg", "420mpeg2", "420paldv")
_EXAMPLE = "ffmpeg -loglevel error -f v4l2 -i /dev/video0 -pix_fmt yuv420p -f yuv4mpegpipe -"


class ImagePipeSource(LiveSource):
    """A camera read by a command of the profile; see `LiveSource`.

    The command writes Y4M, or raw images of a pixel_format.
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
        self._complaints = b""
        self._n_images = 0

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
        self._complaints, self._n_images = b"", 0
        self._stream = ImageStream()
        wanted = self._settings.driver.pixel_format
        if wanted is not None:
            code = find_format(wanted)
            if code is None or FORMATS[code].is_compressed:
                what = f"{self._who}: raw images of driver.pixel_format {wanted!r} are not read"
                raw = ", ".join(code.strip() for code, form in FORMATS.items() if not form.is_compressed)
                raise SourceError(what, f"It can be {raw}, or missing for Y4M.")
            self._stream = ImageStream(PixelDecoder(code, *self._settings.resolution_px))
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
        self._stack.callback(_end_process, self._process)
        self._selector = self._stack.enter_context(selectors.DefaultSelector())
        for pipe in self._pipes():
            os.set_blocking(pipe.fileno(), False)
            self._selector.register(pipe, selectors.EVENT_READ)
        with suppress(OSError):  # fewer, larger reads where the system allows
            fcntl(self._pipes()[0].fileno(), F_SETPIPE_SZ, _PIPE_BYTES)

    def close(self) -> None:
        """Stop the command."""
        self._stack.close()

    def describe(self) -> SourceStatus:
        """Report the state of the camera."""
        clock, device = findings.ARRIVAL(), " ".join(self._settings.driver.command)
        return SourceStatus(self.sensor, clock=clock, device=device)

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
                self._n_images += 1
                yield Image(self.sensor, self._channel, host_ns, pixels, host_ns, self._n_images - 1)
        except ValueError as error:
            hint = f"{self._complaint()}\nRaw images need driver.pixel_format. A command for Y4M: {_EXAMPLE}"
            raise SourceError(f"{self._who}: its command's images: {error}", hint) from None

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


class ImageStream:
    """Bytes in as they come, images out.

    Args:
        decoder: of raw images with nothing between them and no padding of rows; None for YUV4MPEG2 of 8 bits,
            grey or 4:2:0, whose header says what follows.
    """

    def __init__(self, decoder: PixelDecoder | None = None) -> None:
        self._rest = bytearray()
        self._decoder = decoder
        self._is_raw = self._is_in_frame = decoder is not None

    def feed(self, data: bytes) -> Iterator[Pixels]:
        """Take bytes and yield the images that they complete, (H, W) grey or (H, W, 3) BGR.

        Raises:
            ValueError: the stream is not what it began as.
        """
        self._rest += data
        while self._is_in_frame or self._begin_frame():
            assert self._decoder is not None  # as a frame has begun
            if len(self._rest) < self._decoder.n_bytes:
                break
            payload = bytes(self._rest[: self._decoder.n_bytes])
            del self._rest[: len(payload)]
            self._is_in_frame = self._is_raw
            yield self._decoder.decode(payload)

    def _begin_frame(self) -> bool:
        """Read the header of the stream, and of an image; returns whether they have come."""
        if self._decoder is None:
            begin = bytes(self._rest[: len(_Y4M)])
            if not _Y4M.startswith(begin):
                raise ValueError(f"no Y4M: they begin {begin!r}")
            header = self._line()
            if header is None:
                return False
            self._decoder = _decoder_of_y4m(header)
        line = self._line()
        if line is not None and not line.startswith("FRAME"):
            raise ValueError(f"a Y4M frame was expected, {line[:20]!r} came (GStreamer pads rows)")
        self._is_in_frame = line is not None
        return self._is_in_frame

    def _line(self) -> str | None:
        end = self._rest.find(b"\n", 0, _MAX_HEADER)
        if end < 0:
            if len(self._rest) >= _MAX_HEADER:
                raise ValueError("a line of text was expected, other bytes came")
            return None
        line = self._rest[:end].decode("ascii", "backslashreplace").rstrip()
        del self._rest[: end + 1]
        return line


def _decoder_of_y4m(header: str) -> PixelDecoder:
    fields = {word[0]: word[1:] for word in header.split(" ")[1:] if word}
    sides, colour = (fields.get("W", ""), fields.get("H", "")), fields.get("C", "420")
    if not all(side.isdigit() and 0 < int(side) < 65536 for side in sides):
        raise ValueError(f"the Y4M header holds no size: {header[:80]!r}")
    if colour not in _Y4M_COLOURS:
        raise ValueError(f"Y4M colour {colour} is not read here: let the command write 4:2:0, 8 bit")
    width, height = (int(side) for side in sides)
    if width * height > MAX_PIXELS:
        raise ValueError(f"Y4M images of {width}x{height} px are too large: at most {MAX_PIXELS} px")
    if colour != "mono" and (width % 2 or height % 2):
        raise ValueError(f"Y4M images of {width}x{height} px in colour: both must be even")
    return PixelDecoder("GREY" if colour == "mono" else "YU12", width, height)
