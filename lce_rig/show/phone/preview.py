"""The page as the collection sees it: started, updated, closed."""

import asyncio
import logging
import re
import secrets
import socket
import threading
from collections import Counter
from contextlib import suppress

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from lce_rig.collect.live.state import LiveState, TakeBack
from lce_rig.core.errors import UsageError
from lce_rig.show.phone.address import DEFAULT_PORT, LOOPBACK, links, listen
from lce_rig.show.phone.pages import Feed, Pages

# 72 bits: beyond guessing, and can still be typed into a phone.
_TOKEN_BYTES = 9
_TOKEN = re.compile(r"[A-Za-z0-9_-]{8,128}")
_STOP_S, _SHUTDOWN_S, _KEEP_ALIVE_S = 1.5, 0.5, 5.0
# For the rest of a request that was answered before its end.
_CLOSING_S = 0.05
_LINGERING_S = 1.0
_LOG = logging.getLogger("lce_rig.preview")


class _Troubles(logging.Filter):
    """Counts the page's failures; each kind reaches the log once, and what strangers send wrongly never."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError):
            return False
        text = record.getMessage() if error is None else f"{record.msg}: {error!r}"
        kind = text.partition("\n")[0][:120]
        self.counts[kind] += 1
        return self.counts[kind] == 1


class Preview:
    """Serves a page that shows a live collection, and may ask for its last capture to be taken back.

    Only the link with the token opens it; the connection is not encrypted.

    Attributes:
        urls: the links, the likeliest first; empty before `start`.

    Args:
        address: host name or address to bind to; "0.0.0.0" or "::" for all networks.
        port: 0 for any free one.
        token: that a browser must bring; None draws one.

    Raises:
        UsageError: the token cannot be part of a link.
    """

    def __init__(self, address: str = LOOPBACK, port: int = DEFAULT_PORT, token: str | None = None) -> None:
        self.urls: tuple[str, ...] = ()
        self._address = address
        self._port = port
        self._token = secrets.token_urlsafe(_TOKEN_BYTES) if token is None else token
        if not _TOKEN.fullmatch(self._token):
            raise UsageError("the page's token cannot be used", "Take 8 to 128 letters, digits, '-' or '_'.")
        self._thread: threading.Thread | None = None
        self._is_ready = threading.Event()
        self._feed = Feed()
        self._troubles = _Troubles()
        self._pages: Pages | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None

    def start(self) -> str:
        """Begin to serve, in a thread of its own, and give the link.

        Raises:
            UsageError: the port is in use or not permitted, or the address is not this computer's.
        """
        opened = listen(self._address, self._port)
        self.urls = links(opened, self._token)
        self._thread = threading.Thread(target=self._run, args=(opened,), name="preview", daemon=True)
        self._thread.start()
        self._is_ready.wait()
        return self.urls[0]

    def publish(self, state: LiveState) -> None:
        """Show a state; never blocks, and the newest wins. Call it from one thread."""
        self._feed.publish(state)

    def asked(self) -> TakeBack | None:
        """Take the oldest request of a page; None where nothing is asked for."""
        return self._feed.asked()

    @property
    def n_pictures(self) -> int:
        """Images that were compressed, 0 while the page is not open."""
        return 0 if self._pages is None else self._pages.encoder.n_encoded

    def notes(self) -> list[str]:
        """Report the page's failures, and how often; the collection continues after any of them."""
        counts = self._troubles.counts.most_common(20)
        return [f"preview: {kind}" + (f" ({n} times)" if n > 1 else "") for kind, n in counts]

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

    def __exit__(self, *_: object) -> None:
        """End."""
        self.close()

    def _run(self, opened: socket.socket) -> None:
        _LOG.addFilter(self._troubles)
        try:
            asyncio.run(self._serve(opened))
        except Exception:  # If the page ends, the collection continues.
            _LOG.exception("the page has ended, the collection goes on")
        finally:
            _LOG.removeFilter(self._troubles)
            opened.close()
            self._is_ready.set()

    async def _serve(self, opened: socket.socket) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self._pages = Pages(self._token, self._feed)
        runner = web.AppRunner(
            self._pages.application(),
            handle_signals=False,
            access_log=None,
            logger=_LOG,
            shutdown_timeout=_SHUTDOWN_S,
            keepalive_timeout=_KEEP_ALIVE_S,
            lingering_time=_LINGERING_S,
        )
        await runner.setup()
        server = await self._pages.listen(runner, opened)
        self._is_ready.set()
        await self._stop.wait()
        server.close()
        await self._pages.close()
        assert runner.server is not None
        for handler in list(runner.server.connections):
            # A stuck page would keep its connection for ever.
            if handler.transport is not None:
                handler.transport.abort()
        await runner.cleanup()
        # Connections that were cut close in the next turns of the loop.
        await asyncio.sleep(_CLOSING_S)
