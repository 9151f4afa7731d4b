"""The page as the collection sees it: started, told the newest state, closed."""

import asyncio
import socket
import threading
from types import TracebackType

from aiohttp import web

from lce_rig.collect.live.state import LiveState
from lce_rig.collect.preview.access import Gate, check_token, new_token
from lce_rig.collect.preview.address import DEFAULT_PORT, LOOPBACK, is_loopback, links, listen
from lce_rig.collect.preview.feed import Feed
from lce_rig.collect.preview.server import Server, failures_log

_STOP_S = 3.0


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
        """Pictures that were compressed, 0 while nobody watches."""
        return 0 if self._server is None else self._server.encoder.n_encoded

    def close(self) -> None:
        """Let open pages have the last state, and end."""
        if self._thread is None or self._loop is None or self._stop is None:
            return
        if self._thread.is_alive():
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
        try:
            asyncio.run(self._serve(opened))
        finally:
            opened.close()
            self._is_ready.set()

    async def _serve(self, opened: socket.socket) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        gate = Gate(opened.getsockname()[1], self._token, self._address)
        self._server = Server(gate, self._feed)
        runner = web.AppRunner(
            self._server.application(),
            handle_signals=False,
            access_log=None,
            logger=failures_log(),
            shutdown_timeout=1.0,
        )
        await runner.setup()
        await web.SockSite(runner, opened).start()
        self._is_ready.set()
        await self._stop.wait()
        await self._server.say_goodbye()
        # What a stuck page has not taken by now would keep its connection, and this thread, open.
        for each in [] if runner.server is None else runner.server.connections:
            if each.transport is not None:
                each.transport.abort()
        await runner.cleanup()
