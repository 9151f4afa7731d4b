"""Connections to the page: few at once, none that idles, and never the last of the process's descriptors."""

import asyncio
import logging
import resource
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

#: Kinds that are counted separately; clients may cause any number.
_MAX_KINDS = 20
_MAX_TEXT = 120
# asyncio reports by itself what its connections trip over.
_LOGS = ("lce_rig.preview", "asyncio")


class Troubles(logging.Filter):
    """Counts the page's troubles; while its `with` block lasts, each kind reaches the log once.

    What strangers send wrongly is not logged; connections refused or closed are only counted.
    """

    def __init__(self) -> None:
        super().__init__()
        self.log = logging.getLogger(_LOGS[0])
        self._failures: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()

    def count(self, what: str) -> None:
        """Count one of `what`, the words with which the number is reported at the end."""
        self._counts[what] += 1

    def filter(self, record: logging.LogRecord) -> bool:
        """Let the first of each kind of failure through to the log."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError):
            return False
        text = record.getMessage() if error is None else f"{record.msg}: {error!r}"
        kind = text.partition("\n")[0][:_MAX_TEXT]
        if kind not in self._failures and len(self._failures) == _MAX_KINDS:
            kind = "other failures"
        self._failures[kind] += 1
        return self._failures[kind] == 1

    def notes(self) -> list[str]:
        """Report what happened and how often."""
        counted = [f"{n} {what}" for what, n in self._counts.items()]
        failed = [f"{kind} ({n} times)" if n > 1 else kind for kind, n in self._failures.items()]
        return [f"preview: {text}" for text in counted + failed]

    def __enter__(self) -> "Troubles":
        """Watch the logs."""
        for name in _LOGS:
            logging.getLogger(name).addFilter(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the logs alone again."""
        for name in _LOGS:
            logging.getLogger(name).removeFilter(self)


#: At once, in all and from one address. A browser opens six for a page's files, and one for each open page.
MAX_CONNECTIONS = 48
MAX_OF_ONE_PEER = 16
#: A connection that is not a page's line must bring a whole request in so long, and then the next one.
REQUEST_S = 5.0
#: Descriptors that stay free for captures and for sensors that reconnect.
RESERVED_DESCRIPTORS = 64
# Accepting is cheap but not free: at most 800 connections per second take time from guidance.
_BURST, _PAUSE_S = 16, 0.02
_BACK_OFF_S = 1.0
_SWEEP_S = 0.5
# A connection as young as this may still be sending its request.
_MIN_AGE_S = 0.5

_REFUSED = (
    f"connections refused: at most {MAX_CONNECTIONS} at once, {MAX_OF_ONE_PEER} from one address, "
    f"and {RESERVED_DESCRIPTORS} descriptors stay free"
)
_DISPLACED = "idle connections closed to make room for others"
_LATE = f"connections closed: no whole request in {REQUEST_S:g} s"


@dataclass(eq=False)
class _Visitor:
    """One open connection.

    Attributes:
        peer: address of the other end.
        line: its socket.
        since_s: when it was accepted or made its last request.
        is_known: whether the gate has let a request in.
        is_held: whether it feeds an open page.
        is_ending: whether it was cut, which takes until the loop's next turn.
        transport: None while it is being set up.
    """

    peer: str
    line: socket.socket
    since_s: float
    is_known: bool = False
    is_held: bool = False
    is_ending: bool = False
    transport: asyncio.Transport | None = None

    @property
    def is_open(self) -> bool:
        # A transport that closes keeps its descriptor until the other end has read everything.
        return self.line.fileno() != -1

    def abort(self) -> None:
        self.is_ending = True
        if self.transport is not None:
            self.transport.abort()


class Connections:
    """Accepts connections for a web server, within limits.

    Where there is no room, the connection that has idled longest makes way for the newcomer, strangers before
    those the gate has let in: many silent connections keep no viewer out.
    """

    def __init__(self, opened: socket.socket, server: web.Server, troubles: Troubles) -> None:
        """Prepare.

        Args:
            opened: the listening socket.
            server: makes the protocol of each connection.
            troubles: receives refused connections.
        """
        self._opened = opened
        self._server = server
        self._troubles = troubles
        self._loop = asyncio.get_running_loop()
        self._visitors: dict[web.RequestHandler, _Visitor] = {}
        self._setups: set[asyncio.Task[None]] = set()
        self._resume: asyncio.TimerHandle | None = None
        self._sweeping: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Begin to accept."""
        self._opened.setblocking(False)
        self._loop.add_reader(self._opened, self._accept)
        self._sweep()

    def welcome(self, request: web.Request) -> None:
        """Note that the gate has let a request in."""
        visitor = self._visitors.get(request.protocol)
        if visitor is not None:
            visitor.is_known, visitor.since_s = True, time.monotonic()

    @contextmanager
    def holding(self, request: web.Request) -> Iterator[None]:
        """Keep a request's connection open for as long as the block lasts."""
        visitor = self._visitors.get(request.protocol)
        if visitor is None:
            yield
            return
        visitor.is_held = True
        try:
            yield
        finally:
            visitor.is_held, visitor.since_s = False, time.monotonic()

    def close(self) -> None:
        """Accept no more, and cut what is open: a stuck page would keep its connection for ever."""
        self._loop.remove_reader(self._opened)
        for timer in (self._resume, self._sweeping):
            if timer is not None:
                timer.cancel()
        for visitor in self._visitors.values():
            visitor.abort()

    def _accept(self) -> None:
        pause_s = _PAUSE_S
        for _ in range(_BURST):
            try:
                line, address = self._opened.accept()
            except (BlockingIOError, ConnectionAbortedError):
                break
            except OSError as error:
                # Descriptors or memory are used up; the connection stays waiting, so look again later.
                self._troubles.log.warning("no connection can be accepted: %s", error.strerror)
                pause_s = _BACK_OFF_S
                break
            self._receive(line, str(address[0]))
        self._loop.remove_reader(self._opened)
        self._resume = self._loop.call_later(pause_s, self._loop.add_reader, self._opened, self._accept)

    def _receive(self, line: socket.socket, peer: str) -> None:
        self._forget_closed()
        if not self._has_descriptors() or not self._make_room(peer):
            self._troubles.count(_REFUSED)
            line.close()
            return
        line.setblocking(False)
        visitor, protocol = _Visitor(peer, line, time.monotonic()), self._server()
        self._visitors[protocol] = visitor
        setup = self._loop.create_task(self._set_up(visitor, protocol))
        self._setups.add(setup)
        setup.add_done_callback(self._setups.discard)

    async def _set_up(self, visitor: _Visitor, protocol: web.RequestHandler) -> None:
        try:
            visitor.transport, _ = await self._loop.connect_accepted_socket(lambda: protocol, visitor.line)
        except OSError:  # the other end went away
            visitor.line.close()
        if visitor.is_ending:
            visitor.abort()

    def _make_room(self, peer: str) -> bool:
        """Return whether a newcomer can stay, and end another connection where it takes that."""
        staying = [each for each in self._visitors.values() if not each.is_ending]
        of_peer = [each for each in staying if each.peer == peer]
        if len(of_peer) < MAX_OF_ONE_PEER and len(staying) < MAX_CONNECTIONS:
            return True
        rivals = of_peer if len(of_peer) >= MAX_OF_ONE_PEER else staying
        latest_s = time.monotonic() - _MIN_AGE_S
        idle = [each for each in rivals if not each.is_held and each.since_s < latest_s]
        if not idle or sum(each.is_ending for each in self._visitors.values()) >= _BURST:
            return False
        min(idle, key=lambda each: (each.is_known, each.since_s)).abort()
        self._troubles.count(_DISPLACED)
        return True

    def _has_descriptors(self) -> bool:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        if limit == resource.RLIM_INFINITY:
            return True
        with suppress(OSError):  # none is left to look with
            n_open = sum(1 for _ in Path("/proc/self/fd").iterdir())
            return n_open + RESERVED_DESCRIPTORS < limit
        return False

    def _sweep(self) -> None:
        """End connections that bring nothing."""
        self._forget_closed()
        earliest_s = time.monotonic() - REQUEST_S
        for visitor in self._visitors.values():
            if not visitor.is_held and visitor.since_s < earliest_s:
                if not visitor.is_known:
                    self._troubles.count(_LATE)
                visitor.abort()
        self._sweeping = self._loop.call_later(_SWEEP_S, self._sweep)

    def _forget_closed(self) -> None:
        self._visitors = {key: each for key, each in self._visitors.items() if each.is_open}
