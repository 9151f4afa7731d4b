"""The collection's interface to the page: parse addresses, start, update, close."""

import asyncio
import fcntl
import logging
import re
import secrets
import socket
import struct
import threading
from contextlib import suppress

from aiohttp import web

from lce_rig.collect.live.state import LiveState, TakeBack
from lce_rig.core.errors import UsageError
from lce_rig.show.phone import DEFAULT_PORT, LOOPBACK
from lce_rig.show.phone.pages import Feed, Pages

_HINT = (
    "--preview takes HOST:PORT, HOST or PORT, such as 0.0.0.0:8765 or 8080: an address of this computer "
    "(`hostname -I` lists them, 0.0.0.0 stands for all), a free port above 1023 (`ss -ltn` lists used ones)."
)
# ioctl number of linux/sockios.h that Python does not define.
_SIOCGIFADDR = 0x8915
_INTERFACE = struct.Struct("16s20s")


def parse_address(text: str) -> tuple[str, int]:
    """Parse an address: "host:port", "host" or "port"; this computer alone and port 8765 by default.

    Raises:
        UsageError: the text has another form.
    """
    host, colon, port = text.strip().partition(":")
    if not colon and host.isdecimal():
        host, port = "", host
    if re.search(r"[\s/\[\]]", host) or not re.fullmatch("[0-9]{0,5}", port) or int(port or 0) > 65535:
        raise UsageError(f"{text!r} is not an address for the page", _HINT)
    return host or LOOPBACK, int(port or DEFAULT_PORT)


def listen(host: str, port: int) -> socket.socket:
    """Open a socket that listens.

    Raises:
        UsageError: the port is in use or not permitted, or the host is not this computer.
    """
    try:
        return socket.create_server((host, port))
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise UsageError(f"the page cannot be served at {host}:{port}: {why}", _HINT) from None


def links(opened: socket.socket, token: str) -> tuple[str, ...]:
    """Build the links under which a page can be opened, the likeliest first.

    If the socket listens on all addresses, there is one for each IPv4 address of this computer, as the phone
    may be in any of its networks.
    """
    host, port = opened.getsockname()
    hosts = [host]
    if host == "0.0.0.0":
        hosts = _network_addresses() or [f"{socket.gethostname()}.local"]
    return tuple(f"http://{host}:{port}/?token={token}" for host in hosts)


def _network_addresses() -> list[str]:
    """List the IPv4 addresses of this computer's networks, that of the default route first."""
    addresses = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Chooses a route without sending anything (TEST-NET-1, RFC 5737).
            probe.connect(("192.0.2.1", 9))
            addresses.append(str(probe.getsockname()[0]))
        except OSError:
            pass  # no default route, as with a computer that is the access point itself
        for _, name in socket.if_nameindex():
            request = _INTERFACE.pack(name.encode(), b"")
            with suppress(OSError):  # an interface without an IPv4 address
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)
                addresses.append(socket.inet_ntoa(answer[20:24]))
    return [each for each in dict.fromkeys(addresses) if not each.startswith("127.")]


# 72 bits: beyond guessing, and can still be typed into a phone.
_TOKEN_BYTES = 9
_STOP_S, _SHUTDOWN_S, _KEEP_ALIVE_S = 1.5, 0.5, 5.0
# Time to read the rest of a request that was answered before its end, s.
_LINGERING_S = 1.0
# asyncio sets up a connection in the three turns of its loop after it has accepted it.
_TURNS_TO_SET_UP = 4
# Malformed requests from strangers must not be logged on the terminal that shows the collection.
_SILENT = logging.Logger("preview", logging.CRITICAL + 1)


class Preview:
    """Serves a page that shows a live collection, and may ask for its last capture to be taken back.

    Only the link with the token opens it; the connection is not encrypted.

    Attributes:
        urls: the links, the likeliest first; empty before `start`.
        failure: failure that ended the page; "" for none. The collection continues without it.

    Args:
        address: host name or IPv4 address to bind to; "0.0.0.0" for all networks.
        port: port number; 0 for any free one.
        token: token that a browser must send; None for a random one.
    """

    def __init__(self, address: str = LOOPBACK, port: int = DEFAULT_PORT, token: str | None = None) -> None:
        self.urls: tuple[str, ...] = ()
        self.failure = ""
        self._address = address
        self._port = port
        self._token = secrets.token_urlsafe(_TOKEN_BYTES) if token is None else token
        self._thread: threading.Thread | None = None
        self._is_ready = threading.Event()
        self._feed = Feed()
        self._pages: Pages | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None

    def start(self) -> str:
        """Start serving in a separate thread, and return the link.

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
        """Show a state; never blocks, and the newest replaces others. Call it from one thread."""
        self._feed.publish(state)

    def asked(self) -> TakeBack | None:
        """Remove and return the oldest request of a page; None if the queue is empty."""
        return self._feed.asked()

    @property
    def n_pictures(self) -> int:
        """Number of compressed images, 0 while the page is not open."""
        return 0 if self._pages is None else self._pages.encoder.n_encoded

    def close(self) -> None:
        """Send open pages the last state, and stop."""
        if self._thread is None or self._loop is None or self._stop is None:
            return
        if self._thread.is_alive():
            with suppress(RuntimeError):  # the loop has just ended on its own
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
        try:
            asyncio.run(self._serve(opened))
        except Exception as error:
            self.failure = repr(error)
        finally:
            opened.close()
            self._is_ready.set()

    async def _serve(self, opened: socket.socket) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self._pages = Pages(self._token, self._feed)
        runner = web.AppRunner(
            self._pages.application(),
            handle_signals=False,
            access_log=None,
            logger=_SILENT,
            shutdown_timeout=_SHUTDOWN_S,
            keepalive_timeout=_KEEP_ALIVE_S,
            lingering_time=_LINGERING_S,
        )
        await runner.setup()
        await web.SockSite(runner, opened).start()
        self._is_ready.set()
        await self._stop.wait()
        # A connection that is being set up when the server closes would never be closed itself.
        self._loop.remove_reader(opened)
        for _ in range(_TURNS_TO_SET_UP):
            await asyncio.sleep(0)
        await self._pages.close()
        # A stuck page would keep its connection for ever.
        for handler in runner.server.connections if runner.server else []:
            if handler.transport is not None:
                handler.transport.abort()
        await runner.cleanup()
