"""The page as the collection sees it: started, updated, closed."""

import asyncio
import contextlib
import json
import re
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from importlib import resources
from types import TracebackType

from aiohttp import WSMsgType, web

from lce_rig.collect.live.state import LiveState, TakeBack
from lce_rig.show.phone.access import Gate, check_token, guarded, new_token
from lce_rig.show.phone.address import DEFAULT_PORT, LOOPBACK, is_loopback, links, listen
from lce_rig.show.phone.connections import REQUEST_S, Connections, Troubles
from lce_rig.show.phone.state_message import Encoder, Pixels, beat, to_json

# The newest state, handed from the thread that collects to those who watch.

# Requests that wait; somebody who taps faster than the collection listens means one thing.
_MOST_ASKED = 8
# Waking the other thread would cost the collection a system call, and the interpreter's lock with it.
_LOOK_S = 0.03


class Feed:
    """Holds one state, the newest; whoever is slow misses those between. Requests go the other way."""

    def __init__(self) -> None:
        self._newest: tuple[int, float, LiveState] | None = None
        self._asked: deque[TakeBack] = deque(maxlen=_MOST_ASKED)

    def publish(self, state: LiveState) -> None:
        """Put a state in; from one thread at a time. It is a single assignment, so it never blocks."""
        number = 1 if self._newest is None else self._newest[0] + 1
        self._newest = (number, time.monotonic(), state)

    def ask(self, asked: TakeBack) -> None:
        """Put a request of a page in, for the thread that collects; the oldest make way."""
        self._asked.append(asked)

    def asked(self) -> TakeBack | None:
        """Take the oldest request; None where nothing is asked for."""
        return self._asked.popleft() if self._asked else None

    def newest(self) -> tuple[int, LiveState] | None:
        """Give the newest state and its running number, from 1; None before one has come."""
        newest = self._newest
        return None if newest is None else (newest[0], newest[2])

    def age_s(self) -> float | None:
        """Compute how long ago the newest state came."""
        newest = self._newest
        return None if newest is None else time.monotonic() - newest[1]

    async def wait_beyond(self, number: int, timeout_s: float) -> bool:
        """Wait for a state newer than `number`; False where none came in time."""
        end_s = time.monotonic() + timeout_s
        while self._newest is None or self._newest[0] <= number:
            if time.monotonic() > end_s:
                return False
            await asyncio.sleep(_LOOK_S)
        return True


# One open page: sent the newest state as fast as it can follow, and no faster.

#: Between two updates.
PERIOD_S = 0.1
#: Without news the page gets a message this often, and so knows that it is still connected.
BEAT_S = 1.0
#: Updates under way to a page. Two hide the time of their way; more would only grow old in buffers.
MAX_UNDER_WAY = 2
MAX_MESSAGE_BYTES = 256
#: A page that shows no update for so long sleeps; it connects again when it wakes.
ANSWER_S = 5.0


class Viewer:
    """Feeds one connection.

    The page answers each update with its number once it is on the screen, and images are sent to pages that
    are looked at. It may ask for the capture that it shows as the last to be taken back. Nothing else is read
    from it.
    """

    def __init__(self, socket: web.WebSocketResponse, feed: Feed, encoder: Encoder) -> None:
        self._socket = socket
        self._feed = feed
        self._encoder = encoder
        self._n_sent = 0
        self._n_shown = 0
        self._is_looked_at = True
        self._state = 0
        self._delivered = 0
        self._pixels: Pixels | None = None
        self._has_room = asyncio.Event()
        self._has_room.set()

    async def serve(self) -> None:
        """Feed the connection until the page goes away."""
        tasks = {asyncio.create_task(self._read()), asyncio.create_task(self._write())}
        try:
            ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def is_up_to_date(self) -> bool:
        """Return whether the newest state has been sent."""
        newest = self._feed.newest()
        return newest is None or newest[0] <= self._delivered

    async def _read(self) -> None:
        async for received in self._socket:
            if received.type is not WSMsgType.TEXT or not self._take(received.data):
                await self._socket.close(code=1008, message=b"only answers and requests are read")
                return

    async def _write(self) -> None:
        with contextlib.suppress(ConnectionError):  # the page went away
            while True:
                try:
                    await asyncio.wait_for(self._has_room.wait(), ANSWER_S)
                except asyncio.TimeoutError:
                    return
                if await self._feed.wait_beyond(self._state, BEAT_S):
                    began_s = time.monotonic()
                    await self._send_newest()
                    await asyncio.sleep(max(0.0, began_s + PERIOD_S - time.monotonic()))
                else:
                    await self._socket.send_str(beat(self._feed.age_s()))

    async def _send_newest(self) -> None:
        newest = self._feed.newest()
        if newest is not None:
            self._state, state = newest
            await self._send(state)
            self._delivered = newest[0]

    async def _send(self, state: LiveState) -> None:
        jpeg = None
        if state.drawing is not None and self._is_looked_at and state.drawing.pixels is not self._pixels:
            self._pixels = state.drawing.pixels
            jpeg = await self._encoder.encode(state.drawing.pixels)
        self._n_sent += 1
        if self._n_sent - self._n_shown >= MAX_UNDER_WAY:
            self._has_room.clear()
        await self._socket.send_str(to_json(state, self._n_sent, has_picture=jpeg is not None))
        if jpeg is not None:
            await self._socket.send_bytes(jpeg)

    def _take(self, text: str) -> bool:
        """Take {"shown": update, "visible": bool} or {"take_back": name}; False where it is neither."""
        try:
            answer = json.loads(text)
            if "take_back" in answer:
                return self._ask(answer["take_back"])
            shown, is_looked_at = answer["shown"], answer["visible"]
        except (ValueError, TypeError, KeyError, RecursionError):
            return False
        if (
            type(shown) is not int
            or not self._n_shown <= shown <= self._n_sent
            or type(is_looked_at) is not bool
        ):
            return False
        self._n_shown = shown
        if is_looked_at and not self._is_looked_at:
            # What was sent meanwhile had no image.
            self._pixels, self._state = None, 0
        self._is_looked_at = is_looked_at
        if self._n_sent - self._n_shown < MAX_UNDER_WAY:
            self._has_room.set()
        return True

    def _ask(self, name: object) -> bool:
        """Ask for a capture to be taken back; False where that is not the name of one."""
        if not isinstance(name, str) or not re.fullmatch(r"[0-9]{6,20}", name):
            return False
        self._feed.ask(TakeBack(name))
        return True


# The web application: the page's files, and the connection that feeds it.

#: A page that does not answer for so long is gone: a phone out of range says no goodbye.
HEARTBEAT_S = 10.0
#: Pages open at once.
MAX_VIEWERS = 8
_GOODBYE_S = 0.5

_TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
}
# The page loads nothing from elsewhere, and may not be framed.
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Server:
    """What answers requests.

    Attributes:
        encoder: compresses the images.
        connections: through which requests come; None before it serves.
    """

    def __init__(self, gate: Gate, feed: Feed) -> None:
        self.encoder = Encoder()
        self.connections: Connections | None = None
        self._gate = gate
        self._feed = feed
        self._viewers: dict[Viewer, web.WebSocketResponse] = {}
        self._files = _page_files()

    def application(self) -> web.Application:
        """Build the application."""
        app = web.Application(middlewares=[guarded(self._gate, self._welcome)], client_max_size=1024)
        app.on_response_prepare.append(_add_headers)
        app.router.add_get("/live", self._live, allow_head=False)
        app.router.add_get("/", self._file)
        app.router.add_get("/{name}", self._file)
        return app

    async def say_goodbye(self) -> None:
        """Let the pages have the last state, for a moment, and close their connections."""
        for _ in range(10):
            if all(viewer.is_up_to_date() for viewer in self._viewers):
                break
            await asyncio.sleep(_GOODBYE_S / 10)
        # Closing waits until a page has taken what was sent, and a stuck one never does.
        closing = [each.close(code=1001, message=b"closed") for each in self._viewers.values()]
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(asyncio.gather(*closing, return_exceptions=True), _GOODBYE_S)
        self.encoder.close()

    def _welcome(self, request: web.Request) -> None:
        if self.connections is not None:
            self.connections.welcome(request)

    async def _file(self, request: web.Request) -> web.Response:
        name = request.match_info.get("name", "index.html")
        if name not in self._files:
            raise web.HTTPNotFound
        kind, content = self._files[name]
        response = web.Response(body=content, content_type=kind, charset="utf-8")
        self._gate.remember(request, response)
        return response

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if len(self._viewers) >= MAX_VIEWERS:
            return web.Response(status=503, text=f"{MAX_VIEWERS} pages are open already.\n")
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=MAX_MESSAGE_BYTES, timeout=_GOODBYE_S
        )
        await socket.prepare(request)
        viewer = Viewer(socket, self._feed, self.encoder)
        self._viewers[viewer] = socket
        try:
            with contextlib.nullcontext() if self.connections is None else self.connections.holding(request):
                await viewer.serve()
        finally:
            del self._viewers[viewer]
        return socket


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


def _page_files() -> dict[str, tuple[str, bytes]]:
    """Read the page's files: name -> (type, content)."""
    folder = resources.files("lce_rig.show.phone") / "page"
    found = {}
    for entry in folder.iterdir():
        kind = _TYPES.get(entry.name.rpartition(".")[2])
        if kind is not None:
            found[entry.name] = (kind, entry.read_bytes())
    return found


_STOP_S = 1.5
_SHUTDOWN_S = 0.5
# For the rest of a request that was answered before its end.
_LINGERING_S = 1.0


class Preview:
    """Serves a page that shows a live collection, and may ask for its last capture to be taken back.

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

    def asked(self) -> TakeBack | None:
        """Take the oldest request of a page; None where nothing is asked for."""
        return self._feed.asked()

    @property
    def n_pictures(self) -> int:
        """Images that were compressed, 0 while the page is not open."""
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
            except Exception:  # If the page ends, the collection continues.
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
