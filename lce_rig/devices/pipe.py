"""Raw images from a command's standard output: GStreamer, ffmpeg or any other program."""

import os
import selectors
import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from fcntl import F_SETPIPE_SZ, fcntl
from typing import IO

from lce_rig.core.data import Image, LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.devices import findings
from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, find_format
from lce_rig.devices.reading import READ_WAIT_S, LiveSource, SourceStatus
from lce_rig.rig import CameraSettings

# Longest silence before a camera counts as lost, s: commands may take seconds to open one.
_SILENCE_S = 10.0
# Grace period for a command to end, s, before it is killed.
_PATIENCE_S = 2.0
_PIPE_BYTES = 1 << 20
_TAIL_BYTES = 2000
_USUAL_FORMAT = "BGR3"
_EXAMPLE = "ffmpeg -loglevel error -f v4l2 -i /dev/video0 -pix_fmt bgr24 -f rawvideo -"


class ImagePipeSource(LiveSource):
    """A camera read by a command from the profile; see `LiveSource`.

    The command writes images of the profile's size and pixel_format, without padding. The
    stream carries no timestamps: images get the arrival time of their last byte, as the status states.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
    """

    def __init__(self, sensor: str, settings: CameraSettings) -> None:
        hint = f"Run its command in a shell and check for images: {' '.join(settings.driver.command)}"
        super().__init__(sensor, f"camera {sensor!r}", _SILENCE_S, hint)
        self._settings = settings
        self._channel = settings.first_channel("frames") or "frames"
        self._stack = ExitStack()
        self._complaints = b""
        self._n_images = 0

    def open(self) -> None:
        """Start the command.

        Raises:
            SourceError: there is no command, or it cannot be started.
        """
        command = self._settings.driver.command
        if not command:
            line = "driver: {type: command, command: [PROGRAM, ARGUMENT, ...]}"
            hint = f"Add to cameras.{self.sensor}: {line}\nAn example of a command: {_EXAMPLE}"
            raise SourceError(f"{self.sensor}: the profile does not say how it is reached", hint)
        self._complaints, self._n_images = b"", 0
        wanted = self._settings.driver.pixel_format or _USUAL_FORMAT
        code = find_format(wanted)
        if code is None or FORMATS[code].is_compressed:
            what = f"{self._label}: raw images of driver.pixel_format {wanted!r} are not supported"
            raw = ", ".join(code.strip() for code, form in FORMATS.items() if not form.is_compressed)
            raise SourceError(what, f"It can be {raw}, or missing for {_USUAL_FORMAT}.")
        self._decoder, self._rest = PixelDecoder(code, *self._settings.resolution_px), bytearray()
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,  # Ctrl-C reaches only this program, which then stops the command
            )
        except OSError as error:
            hint = "Install the program, or give its full path."
            what = f"{self._label}: {command[0]} cannot be started: {error.strerror}"
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
        """Return the received images; see `LiveSource`."""
        pictures, complaints = self._pipes()
        samples: list[LiveSample] = []
        for key, _ in self._selector.select(READ_WAIT_S):
            data = os.read(key.fd, _PIPE_BYTES)
            if key.fileobj is complaints:
                self._complaints = (self._complaints + data)[-_TAIL_BYTES:]
                if not data:
                    self._selector.unregister(complaints)
            elif data:
                self._rest += data
            else:
                self._raise_end(pictures)
        n_bytes, host_ns = self._decoder.n_bytes, time.time_ns()
        while len(self._rest) >= n_bytes:
            pixels = self._decoder.decode(bytes(self._rest[:n_bytes]))
            del self._rest[:n_bytes]
            samples.append(Image(self.sensor, self._channel, host_ns, pixels, host_ns, self._n_images))
            self._n_images += 1
        return samples

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
        lines = self._complaints.decode("utf-8", "replace").strip().splitlines()[-3:]
        hint = f"Run it in a shell: {' '.join(self._settings.driver.command)}"
        if lines:
            hint = f"It said: {' | '.join(line.strip() for line in lines)}"
        raise SourceError(f"{self._label}: its command {how} after {self._n_images} images", hint)


def _end_process(process: "subprocess.Popen[bytes]") -> None:
    """Stop the command and its child processes, by force if necessary."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
            break
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
