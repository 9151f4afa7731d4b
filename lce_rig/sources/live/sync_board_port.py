"""The serial port of a sync board, opened without resetting it, its failures explained."""

import errno
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from lce_rig.core.errors import SourceError

_READ_S = 0.02
_WRITE_S = 0.2
_BY_ID = Path("/dev/serial/by-id")


class BoardPort:
    """An open serial port, for this program alone.

    Attributes:
        n_unwritten: commands that did not go out because the board took nothing.
    """

    def __init__(self, who: str, device: str, baud: int) -> None:
        """Open the port.

        DTR and RTS are low before it opens: on many boards they are wired to the reset. Some kernels raise
        them for a moment all the same.

        Raises:
            SourceError: it is absent, busy, not permitted or no serial port, or pyserial is missing.
        """
        self.n_unwritten = 0
        self._who = who
        self._device = device
        try:
            import serial
        except ImportError:
            raise SourceError(f"{who} needs the package pyserial", "Run: pip install pyserial") from None
        self._failures: tuple[type[Exception], ...] = (serial.SerialException, OSError)
        self._timeouts: type[Exception] = serial.SerialTimeoutException
        self._port: Any = serial.Serial()
        self._port.port = device
        self._port.baudrate = baud
        self._port.timeout = _READ_S
        self._port.write_timeout = _WRITE_S
        self._port.exclusive = True
        self._port.dtr = False
        self._port.rts = False
        try:
            self._port.open()
        except (*self._failures, ValueError) as error:
            raise _explained(who, device, error) from None

    def read(self) -> bytes:
        """Wait for bytes, 20 ms at most, and give what is there.

        Raises:
            SourceError: the board was unplugged.
        """
        try:
            return bytes(self._port.read(max(1, self._port.in_waiting)))
        except self._failures as error:
            raise self._gone(error) from None

    def write(self, data: bytes) -> int:
        """Send a command; gives the time of day in ns when it went out.

        Raises:
            SourceError: the board was unplugged.
        """
        sent_ns = time.time_ns()
        try:
            self._port.write(data)
        except self._timeouts:
            self.n_unwritten += 1
        except self._failures as error:
            raise self._gone(error) from None
        return sent_ns

    def close(self) -> None:
        """Close the port; never raises."""
        try:
            self._port.close()
        except self._failures:
            return

    def __enter__(self) -> "BoardPort":
        """Use the port until the block ends."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        self.close()

    def _gone(self, error: Exception) -> SourceError:
        return SourceError(
            f"{self._who} on {self._device} is gone: {_cause(error)}",
            "Check its plug and cable and its power; what was captured before is safe. Begin again when "
            "`ls -l /dev/serial/by-id` shows it.",
        )


def _cause(error: Exception) -> str:
    number = getattr(error, "errno", None)
    return f"{errno.errorcode.get(number, number)}" if number else str(error).partition("(")[0].strip()


def _explained(who: str, device: str, error: Exception) -> SourceError:
    """Say why a port cannot be opened, and what to do about it."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        found = sorted(path.name for path in _BY_ID.iterdir()) if _BY_ID.is_dir() else []
        there = f"there is {', '.join(f'{_BY_ID}/{name}' for name in found)}" if found else "no port is there"
        return SourceError(f"{who}: there is no {device}", f"Check plug and cable, and sync.device; {there}.")
    if number in (errno.EACCES, errno.EPERM):
        hint = "Run: sudo usermod -aG dialout $USER, then log in again."
        return SourceError(f"{who}: {device} may not be opened by this user", hint)
    if number in (errno.EBUSY, errno.EAGAIN):
        hint = f"Close it: a serial monitor, ModemManager or another lce-rig. `fuser {device}` shows which."
        return SourceError(f"{who}: {device} is in use by another program", hint)
    if number in (errno.ENOTTY, errno.EINVAL) or "configure" in str(error):
        return SourceError(f"{who}: {device} is no serial port", "Check sync.device in the profile.")
    return SourceError(f"{who}: {device} cannot be opened: {error}", "Check sync.device in the profile.")
