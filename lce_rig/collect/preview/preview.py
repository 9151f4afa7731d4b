"""The page as the collection sees it: started, told the newest state, closed."""

import asyncio
import socket
import threading
from contextlib import suppress
from types import TracebackType

from aiohttp import web

from lce_rig.collect.live.state import LiveState
from lce_rig.collect.preview.access import Gate, check_token, new_token
from lce_rig.collect.preview.address import DEFAULT_PORT, LOOPBACK, is_loopback, links, listen
from lce_rig.collect.preview.connections import REQUEST_S, Connections
from lce_rig.collect.preview.feed import Feed
from lce_rig.collect.preview.server import Server
from lce_rig.collect.preview.troubles import Troubles

_STOP_S = 1.5
_SHUTDOWN_S = 0.5
# For the rest of a request that was answered before its end.
_LINGERING_S = 1.0


class Preview:
    """Serves a page that shows a live collection; read only.

    On this computer alone it needs no token. Bound to any other address it does, and only the link with the
    token opens it; the connection is not encrypted.

    Attributes:
        urls: the links, the likeliest first; empty before `start`.

    Args:
        address: host name or address to bind to; "0.0.0.0" or "::" for all networks.
        port: 0 for any free one.
        token: who opens the page must know; drawn where it is None and one is needed.

    Raises:
        UsageError: the token cannot be part of a link.
    """

    def __init__(self, address: str = LOOPBACK, port: int = DEFAULT_PORT, token: str | None = None) -> None:
        self.urls: tuple[str, ...] = ()
        self._address = address
        self._port = port
        self._token = None if token is None else check_token(token)
        self._thread: threading.Thread | None = None
        self._is_ready = threading.Event()
        self._feed = Feed()
        self._troubles = Troubles()
        self._server: Server | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None

    def start(self) -> str:
        """Begin to serve, in a thread of its own, and give the link.

        Raises:
            UsageError: the port is in use or not permitted, or the address is not this computer's.
        """
        opened = listen(self._address, self._port)
        if self._token is None and not is_loopback(opened):
            self._token = new_token()
        self.urls = links(opened, self._token)
        self._thread = threading.Thread(target=self._run, args=(opened,), name="preview", daemon=True)
        self._thread.start()
        self._is_ready.wait()
        return self.urls[0]

    def publish(self, state: LiveState) -> None:
        """Show a state; never blocks, and the newest wins. Call it from one thread."""
        self._feed.publish(state)

    @property
    def n_pictures(self) -> int:
        """Images that were compressed, 0 while nobody watches."""
        return 0 if self._server is None else self._server.encoder.n_encoded

    def notes(self) -> list[str]:
        """Report the page's failures, and how often; the collection continues after any of them."""
        return self._troubles.notes()

    def close(self) -> None:
        """Let open pages have the last state, and end."""
        if self._thread is None or self._loop is None or self._stop is None:
            return
        if self._thread.is_alive():
            with suppress(RuntimeError):  # its loop has just ended by itself
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(_STOP_S)
        self._thread = None

    def __enter__(self) -> "Preview":
        """Begin to serve."""
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End."""
        self.close()

    def _run(self, opened: socket.socket) -> None:
        with self._troubles, opened:
            try:
                asyncio.run(self._serve(opened))
            except Exception:  # Whatever ends the page, the collection continues.
                self._troubles.log.exception("the page has ended, the collection goes on")
            finally:
                self._is_ready.set()

    async def _serve(self, opened: socket.socket) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        gate = Gate(opened.getsockname()[1], self._token, self._address)
        self._server = Server(gate, self._feed)
        runner = web.AppRunner(
            self._server.application(),
            handle_signals=False,
            access_log=None,
            logger=self._troubles.log,
            shutdown_timeout=_SHUTDOWN_S,
            keepalive_timeout=REQUEST_S,
            lingering_time=_LINGERING_S,
        )
        await runner.setup()
        assert runner.server is not None
        connections = self._server.connections = Connections(opened, runner.server, self._troubles)
        connections.begin()
        self._is_ready.set()
        await self._stop.wait()
        await self._server.say_goodbye()
        connections.close()
        await runner.cleanup()
