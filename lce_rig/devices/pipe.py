"""Images from a command's standard output: GStreamer, ffmpeg or any program that writes them."""

import os
import re
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
from lce_rig.devices.image_streams import ImageStream, JpegImages, RawImages, find_stream
from lce_rig.devices.pixel_formats import FORMATS, find_format
from lce_rig.devices.protocol import ClockState, SourceStatus
from lce_rig.devices.reading import LiveSource
from lce_rig.rig import CameraSettings

_N_SLOTS = 16
_WAIT_S = 0.25
_PATIENCE_S = 2.0
_PIPE_BYTES = 1 << 20
_N_BEGIN = 16
# What no raw image begins with: a whole header of PGM or PPM, or that of Y4M.
_HEADER = re.compile(rb"P[56]\s\d+\s\d+\s|YUV4MPEG2 ")
_TAIL_BYTES = 2000
_EXAMPLE = (
    "gst-launch-1.0 -q v4l2src device=/dev/video0 ! videoconvert ! video/x-raw,format=I420 ! y4menc ! fdsink"
)


class ImagePipeSource(LiveSource):
    """A camera read by a command of the profile; see `LiveSource`.

    The command writes Y4M, PGM, PPM or JPEG images, one behind the other, or raw ones of a pixel_format.
    Such a stream carries no usable timestamps: those given are the arrival of an image's last byte
    as it is, and the status says so.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        silence_s: so long without an image is an error.
    """

    def __init__(self, sensor: str, settings: CameraSettings, silence_s: float = 10.0) -> None:
        hint = f"Run its command in a shell: does it write images? {' '.join(settings.driver.command)}"
        super().__init__(sensor, f"camera {sensor!r}", _N_SLOTS, silence_s, hint)
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
                raise SourceError(what, f"It can be {known}, or missing for Y4M, PGM, PPM and JPEG.")
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
        if isinstance(self._stream, RawImages) and self._stream.row_bytes % 4:
            n_row = self._stream.row_bytes
            problems.append(findings.ROW_PADDING(row_bytes=n_row, padded_bytes=n_row + -n_row % 4))
        return SourceStatus(
            self.sensor,
            n_lost=n_damaged,
            clock=ClockState(findings.ARRIVAL()),
            problems=tuple(problems),
            device=" ".join(self._settings.driver.command),
        )

    def _begin_stream(self) -> None:
        """Find out by its first bytes what the command writes, and whether it is what the profile says.

        Raises:
            SourceError: it is nothing that is read, or no raw images though the profile says so.
        """
        if self._stream is None:
            self._stream = find_stream(self._begin)
            if self._stream is None:
                begin = self._begin[:16]
                what = f"{self._who}: its command writes no Y4M, PGM, PPM or JPEG; it begins {begin!r}"
                raise SourceError(what, f"For raw images set driver.pixel_format. An example: {_EXAMPLE}")
        elif isinstance(self._stream, RawImages) and _HEADER.match(self._begin):
            wanted = self._settings.driver.pixel_format
            raise SourceError(
                f"{self._who}: driver.pixel_format says raw {wanted}, but its command writes images with a "
                f"header: {self._begin[:16]!r}",
                "Leave pixel_format out: such images name their form themselves.",
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
            self._begin_stream()
        assert self._stream is not None  # it has begun
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
        n_left = self._stream.n_left if self._stream else len(self._begin)
        torn = f"; {n_left} bytes of an unfinished image were skipped" if n_left else ""
        what = f"{self._who}: its command {how} after {self._n_images} images{torn}"
        raise SourceError(what, self._complaint())

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
