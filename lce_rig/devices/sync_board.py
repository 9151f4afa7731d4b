"""A sync board on a serial port: its trigger pulses, and its clock synchronised with the computer's."""

import errno
import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import serial

from lce_rig.core.data import Pulse
from lce_rig.core.errors import SourceError
from lce_rig.devices import lce1
from lce_rig.devices.lce1 import Arrival, BoardState
from lce_rig.devices.reading import LiveSource, SourceStatus
from lce_rig.rig.profile import BOARD, SyncSettings
from lce_rig.timing.clock import NS_PER_S, ClockModel

# Time to wait for the board, s: opening the port may reset it, and a VLP-16 takes 2.3 s to lock on its pulses
# again.
HELLO_S = 6.0
SILENCE_S = 30.0

_BY_ID = Path("/dev/serial/by-id")
_N_SLOTS = 4096
_GREET_AGAIN_NS = NS_PER_S
_ANSWER_WITHIN_NS = NS_PER_S // 2
_ASK_EVERY_NS = NS_PER_S // 10
_SET_UTC_EVERY_NS = 10 * NS_PER_S
_UTC_SIGMA_NS = 1_000_000
_UTC_MIN_ANSWERS = 8
_N_HEARD_BYTES = 40


class SyncBoard(LiveSource):
    """An attached sync board; a `LiveSource` of pulses.

    A reader thread always drains the port: otherwise some boards block and hold their pulse high.

    Args:
        settings: the board's port, and the camera triggered by each line.
        hello_s: longest wait for its first message.
    """

    def __init__(self, settings: SyncSettings, hello_s: float = HELLO_S) -> None:
        super().__init__(BOARD, f"sync board '{BOARD}'", math.inf, n_slots=_N_SLOTS)
        self._settings = settings
        self._hello_s = hello_s
        self._state = BoardState({trigger.channel: camera for camera, trigger in settings.triggers.items()})
        self._lock = threading.Lock()
        self._early: list[Pulse] = []
        self._heard = b""
        self._outbox: deque[str] = deque()
        self._rate_hz: float | None = None
        self._n_restarts = self._cookie = 0
        self._asked_ns = self._told_utc_ns = self._greeted_ns = 0
        self._is_set_up = False
        self._port: serial.Serial | None = None

    def open(self) -> None:
        """Open the port, wait for the board's first message, configure its lines and start them.

        Raises:
            SourceError: the port cannot be opened, or the board is silent or uses another protocol.
        """
        # DTR and RTS stay low on opening: many boards wire them to the reset. Some kernels still raise them
        # briefly.
        port = serial.Serial(baudrate=self._settings.port_baud, timeout=0.02, write_timeout=0.2)
        port.port, port.exclusive = self._settings.device, True
        port.dtr = port.rts = False
        try:
            port.open()
        except (serial.SerialException, OSError, ValueError) as error:
            raise self._explain(error) from None
        self._port = port
        self._early, self._heard, self._is_set_up = [], b"", False
        with self._lock:
            self._state.opened(time.monotonic_ns())
        until_s = time.monotonic() + self._hello_s
        while not self._is_set_up and not self.is_stopping:
            self._early = self.read()
            if not self._is_set_up and time.monotonic() > until_s:
                device, baud = self._settings.device, self._settings.port_baud
                if not self._heard:
                    raise SourceError(
                        f"{self._label} on {device} is silent: nothing for {self._hello_s:g} s",
                        "Check its power and firmware, and that sync.device is its port.",
                    )
                raise SourceError(
                    f"{self._label} on {device} does not talk LCE1: {self._heard!r}",
                    f"Check sync.baud (now {baud}), that this is the board's port, and its firmware.",
                )
        hello = self._state.hello
        if hello is not None and hello.version != lce1.VERSION:
            raise SourceError(
                f"{self._label} uses version {hello.version} of LCE1, but this program {lce1.VERSION}",
                "Flash the firmware of this version of lce-rig.",
            )

    def close(self) -> None:
        """Close the port; the board's pulses continue, so that the LiDAR stays locked."""
        if self._port is not None:
            with suppress(serial.SerialException, OSError):
                self._port.close()

    def read(self) -> list[Pulse]:
        """Return the received pulses, and send the commands that are due.

        Their `sensor` is the camera, or "pps"; timestamps are the board's own time.

        Raises:
            SourceError: the board was unplugged, or fell silent permanently.
        """
        assert self._port is not None  # it is open
        early, self._early = self._early, []
        with self._reaching_board():
            data = bytes(self._port.read(max(1, self._port.in_waiting)))
        arrival = Arrival(time.time_ns(), time.monotonic_ns())
        self._heard = (self._heard + data)[:_N_HEARD_BYTES]
        with self._lock:
            pulses = self._state.feed(data, arrival)
            if self._is_set_up and arrival.steady_ns - self._state.heard_ns > SILENCE_S * NS_PER_S:
                raise SourceError(
                    f"{self._label} fell silent: nothing for {SILENCE_S:g} s",
                    "Check its cable and power, and press its reset.",
                )
            has_restarted = self._state.n_restarts != self._n_restarts
            if has_restarted:
                self._n_restarts, self._told_utc_ns = self._state.n_restarts, 0
            if has_restarted or (not self._is_set_up and self._state.hello is not None):
                self._set_lines()
                self._is_set_up = True
        self._talk(arrival.steady_ns)
        return early + pulses

    def describe(self) -> SourceStatus:
        """Report the state of the board."""
        with self._lock:
            state, hello = self._state, self._state.hello
            return SourceStatus(
                self.sensor,
                n_lost=sum(state.n_lost_by_line.values()),
                clock=state.clock_state(),
                problems=state.problems(time.monotonic_ns()),
                device=f"{hello.board}, firmware {hello.firmware}, LCE{hello.version}" if hello else "",
                n_lost_by_line=dict(state.n_lost_by_line),
            )

    @property
    def host_clock(self) -> ClockModel | None:
        """The computer's time of day on the board's clock; None before it is known."""
        with self._lock:
            return self._state.host_tracker.model

    @property
    def utc_clock(self) -> ClockModel | None:
        """UTC on the board's clock, which is the LiDAR's; None if the board does not know UTC."""
        with self._lock:
            return self._state.utc_tracker.model

    def start_triggers(self, rate_hz: float | None = None) -> None:
        """Start the trigger pulses of the cameras; sequence numbers continue.

        Args:
            rate_hz: rate of all lines, for slow pulses that images can be matched to; None for the
                profile's.
        """
        with self._lock:
            self._rate_hz = rate_hz
            self._set_lines()

    def _write(self, command: str) -> int:
        """Send a command's name and fields; return the time of day of sending, ns."""
        assert self._port is not None  # it is open
        sent_ns = time.time_ns()
        # A board that accepts no commands sends no replies either, which is reported.
        with self._reaching_board(), suppress(serial.SerialTimeoutException):
            self._port.write(lce1.write_sentence(command))
        return sent_ns

    @contextmanager
    def _reaching_board(self) -> Iterator[None]:
        try:
            yield
        except (serial.SerialException, OSError) as error:
            number = getattr(error, "errno", None)
            cause = errno.errorcode.get(number, number) if number else str(error).partition("(")[0].strip()
            raise SourceError(
                f"{self._label} on {self._settings.device} is gone: {cause}",
                "Check its plug and cable and its power; what was captured before is safe. Begin again when "
                "`ls -l /dev/serial/by-id` shows it.",
            ) from None

    def _explain(self, error: Exception) -> SourceError:
        """Explain why the port cannot be opened, with an action."""
        number, device = getattr(error, "errno", None), self._settings.device
        what = f"{self._label}: {device}"
        if number == errno.ENOENT:
            ports = sorted(map(str, _BY_ID.iterdir())) if _BY_ID.is_dir() else []
            listing = f"choose one of: {', '.join(ports)}" if ports else "no port is there"
            return SourceError(f"{what} is not there", f"Check plug and cable, and sync.device; {listing}.")
        if number in (errno.EACCES, errno.EPERM):
            hint = "Run: sudo usermod -aG dialout $USER, then log in again."
            return SourceError(f"{what} may not be opened by this user", hint)
        if number in (errno.EBUSY, errno.EAGAIN):
            hint = f"Close it: a serial monitor, ModemManager or another lce-rig. `fuser {device}`."
            return SourceError(f"{what} is in use by another program", hint)
        return SourceError(f"{what} cannot be opened: {error}", "Check sync.device in the profile.")

    def _set_lines(self) -> None:
        """Queue the commands that set the lines of a board that has just started."""
        for trigger in self._settings.triggers.values():
            rate_hz = self._rate_hz or trigger.rate_hz
            line = f"{trigger.channel},{rate_hz:.6f},{trigger.phase_us},{trigger.pulse_us}"
            self._outbox.append(f"LCERT,{line}")
        if self._settings.triggers:
            self._outbox.append("LCEGO")

    def _talk(self, now_ns: int) -> None:
        """Send the greetings, commands, UTC and time requests that are due."""
        if not self._is_set_up:
            if now_ns - self._greeted_ns > _GREET_AGAIN_NS:
                self._greeted_ns = now_ns
                self._write("LCEHI?")
            return
        while self._outbox:
            self._write(self._outbox.popleft())
        if now_ns - self._told_utc_ns > _SET_UTC_EVERY_NS:
            self._tell_utc(now_ns)
        is_free = self._state.has_answered or now_ns - self._asked_ns > _ANSWER_WITHIN_NS
        if is_free and now_ns - self._asked_ns > _ASK_EVERY_NS:
            self._asked_ns = now_ns
            self._cookie += 1
            # The same thread reads the reply, so the reply cannot precede this entry.
            self._state.asked(self._cookie, self._write(f"LCETM?,{self._cookie}"))

    def _tell_utc(self, now_ns: int) -> None:
        """At the start of a second, send the computer's UTC to a board without a receiver."""
        with self._lock:
            pps, model = self._state.pps, self._state.host_tracker.model
        if pps is None or pps[0].origin == "G" or model is None or model.n_used < _UTC_MIN_ANSWERS:
            return
        utc_s = time.time_ns() // NS_PER_S + 2
        board_clock = model.inverse()
        if board_clock.sigma_ns(utc_s * NS_PER_S) < _UTC_SIGMA_NS:
            self._told_utc_ns = now_ns
            board_us = round(board_clock.convert(utc_s * NS_PER_S) / 1000)
            self._write(f"LCEUT,{board_us},{utc_s}")
