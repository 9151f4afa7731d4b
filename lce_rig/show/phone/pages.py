"""The web application behind the page: its files, the token, and the connection that feeds each open page."""

import asyncio
import hmac
import ipaddress
import json
import math
import re
import socket
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from importlib import resources
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
from aiohttp import WSMsgType, web
from aiohttp.typedefs import Handler
from numpy.typing import NDArray

from lce_rig.collect.guidance.planner import Coverage
from lce_rig.collect.live.state import Cue, LiveState, StreamState, TakeBack
from lce_rig.core.geometry import Array

Pixels = NDArray[np.uint8]

#: Maximum width of the image, px: sharp enough on a phone, small enough for its radio link.
MAX_WIDTH_PX = 960
_QUALITY = 75
# Messages on the page: a collection runs for hours, only the last ones are shown.
_MAX_LOG = 50


def to_json(state: LiveState, *, has_picture: bool) -> str:
    """Write a state, without its image, as JSON for the page; unknown values are null.

    Args:
        state: the state.
        has_picture: whether a JPEG of the drawing follows.
    """
    document = state._asdict() | {"log": state.log[-_MAX_LOG:]}
    if state.drawing is not None:
        height, width = state.drawing.pixels.shape[:2]
        document["drawing"] = {
            "camera": state.drawing.camera,
            "width_px": width,
            "height_px": height,
            "present_px": _outline(state.drawing.present_px),
            "wanted_px": _outline(state.drawing.wanted_px),
            "is_there": bool(state.drawing.is_there),
            "has_picture": has_picture,
        }
    return json.dumps(_plain(document), allow_nan=False)


def _plain(value: Any) -> Any:
    """Convert records and tuples to JSON types; numbers that are not finite become None."""
    if isinstance(value, Coverage):
        value = asdict(value)
    elif isinstance(value, (StreamState, Cue)):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def beat(age_s: float | None) -> str:
    """Write the message for a page without news: the age of the last state, or None before the first."""
    return json.dumps({"beat": True, "age_s": None if age_s is None else round(age_s, 1)})


def encode_picture(pixels: Pixels) -> bytes:
    """Compress an image, (H, W) or (H, W, 3) BGR, at most `MAX_WIDTH_PX` wide."""
    height, width = pixels.shape[:2]
    shrinkage = width / MAX_WIDTH_PX
    if shrinkage > 1:
        # Means over areas are fast for whole factors only, and below two there is little to be averaged.
        kind = cv2.INTER_LINEAR if shrinkage < 2 else cv2.INTER_AREA
        shrinkage = shrinkage if shrinkage < 2 else math.ceil(shrinkage)
        size = (round(width / shrinkage), max(1, round(height / shrinkage)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=kind), np.uint8)
    _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return bytes(jpeg)


class Encoder:
    """Compresses each image once for all viewers, in a separate thread.

    Attributes:
        n_encoded: images compressed.
    """

    def __init__(self) -> None:
        self.n_encoded = 0
        self._pixels: Pixels | None = None
        self._jpeg: asyncio.Future[bytes] | None = None
        self._thread = ThreadPoolExecutor(1, "preview-pictures")

    async def encode(self, pixels: Pixels) -> bytes:
        """Return the image as JPEG; each image is encoded once."""
        if self._jpeg is None or self._pixels is not pixels:
            loop = asyncio.get_running_loop()
            self._pixels, self._jpeg = pixels, loop.run_in_executor(self._thread, encode_picture, pixels)
            self.n_encoded += 1
        # A viewer that leaves must not affect the others.
        return await asyncio.shield(self._jpeg)

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown()


def _outline(points_px: Array | None) -> list[list[float] | None] | None:
    """Round an outline to tenths of a pixel; a point out of the lens's sight is None."""
    if points_px is None:
        return None
    is_seen = np.asarray(np.isfinite(points_px).all(axis=1))
    rounded = np.round(np.where(is_seen[:, None], points_px, 0.0), 1).tolist()
    return [point if is_point else None for point, is_point in zip(rounded, is_seen, strict=True)]


# Maximum requests in the queue: repeated quick taps mean one request.
_MOST_ASKED = 8
# Waking the other thread would cost the collection a system call, and the interpreter's lock with it.
_LOOK_S = 0.03
#: Time between two updates, s.
PERIOD_S = 0.1
#: Time without news after which the page gets a message, s, so that it sees the connection is alive.
BEAT_S = 1.0
MAX_MESSAGE_BYTES = 256
#: Time without an answer after which a page sleeps or is out of range, s; it reconnects when it wakes.
ANSWER_S = 5.0
#: Time for a page to close its connection, s.
GOODBYE_S = 0.5
_COOKIE = "lce_rig_preview"
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
# The page loads nothing from elsewhere, and may not be framed.
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Feed:
    """Passes states to the page, and requests back. Only the newest state is kept."""

    def __init__(self) -> None:
        self._newest: tuple[int, float, LiveState] | None = None
        self._asked: deque[TakeBack] = deque(maxlen=_MOST_ASKED)

    def publish(self, state: LiveState) -> None:
        """Store a state; call from one thread only. It is a single assignment, so it never blocks."""
        number = 1 if self._newest is None else self._newest[0] + 1
        self._newest = (number, time.monotonic(), state)

    def ask(self, asked: TakeBack) -> None:
        """Queue a request of a page for the thread that collects; the oldest are dropped."""
        self._asked.append(asked)

    def asked(self) -> TakeBack | None:
        """Remove and return the oldest request; None if the queue is empty."""
        return self._asked.popleft() if self._asked else None

    def newest(self) -> tuple[int, LiveState] | None:
        """Return the newest state and its sequence number, from 1; None before the first."""
        newest = self._newest
        return None if newest is None else (newest[0], newest[2])

    def age_s(self) -> float | None:
        """Return the age of the newest state."""
        newest = self._newest
        return None if newest is None else time.monotonic() - newest[1]

    async def wait_beyond(self, number: int, timeout_s: float) -> bool:
        """Wait for a state newer than `number`; False on timeout."""
        end_s = time.monotonic() + timeout_s
        while self._newest is None or self._newest[0] <= number:
            if time.monotonic() > end_s:
                return False
            await asyncio.sleep(_LOOK_S)
        return True


class Viewer:
    """Sends the newest state to one open page as fast as the page can follow.

    The page answers each message once it is on the screen, and reports whether it is visible; only then are
    images sent. It may also request to reject the last capture that it shows. Nothing else is read
    from it.
    """

    def __init__(self, line: web.WebSocketResponse, feed: Feed, encoder: Encoder) -> None:
        self._line = line
        self._feed = feed
        self._encoder = encoder
        self._is_looked_at = True
        self._state = 0
        self._delivered = 0
        self._pixels: Pixels | None = None

    async def serve(self) -> None:
        """Feed the page until it closes, sleeps or sends an invalid message."""
        is_answered = True
        with suppress(ConnectionError, asyncio.TimeoutError):
            while is_answered:
                is_new = await self._feed.wait_beyond(self._state, BEAT_S)
                began_s, newest = time.monotonic(), self._feed.newest()
                if is_new and newest is not None:
                    self._state, state = newest
                    await asyncio.wait_for(self._send(state), ANSWER_S)
                    self._delivered = newest[0]
                else:
                    await self._line.send_str(beat(self._feed.age_s()))
                is_answered = await self._read_answer()
                await asyncio.sleep(max(0.0, began_s + PERIOD_S - time.monotonic()))
            await self._line.close(code=1008, message=b"only answers and requests are read")

    async def close(self) -> None:
        """Wait briefly until the page has the last state, and close the connection."""
        for _ in range(10):
            newest = self._feed.newest()
            if newest is None or newest[0] <= self._delivered:
                break
            await asyncio.sleep(GOODBYE_S / 10)
        # Closing waits until the page has read all messages; a stuck page never does.
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._line.close(code=1001, message=b"closed"), GOODBYE_S)

    async def _send(self, state: LiveState) -> None:
        jpeg = None
        if state.drawing is not None and self._is_looked_at and state.drawing.pixels is not self._pixels:
            self._pixels = state.drawing.pixels
            jpeg = await self._encoder.encode(state.drawing.pixels)
        await self._line.send_str(to_json(state, has_picture=jpeg is not None))
        if jpeg is not None:
            await self._line.send_bytes(jpeg)

    async def _read_answer(self) -> bool:
        """Read up to {"visible": bool}, and requests {"take_back": name}; False for anything else."""
        while True:
            received = await self._line.receive(ANSWER_S)
            try:
                said = json.loads(received.data) if received.type is WSMsgType.TEXT else None
            except (ValueError, RecursionError):
                return False
            match said:
                case {"visible": bool(is_looked_at)}:
                    if is_looked_at and not self._is_looked_at:
                        # The states sent meanwhile had no image.
                        self._pixels, self._state = None, 0
                    self._is_looked_at = is_looked_at
                    return True
                case {"take_back": str(name)} if re.fullmatch(r"[0-9]{6,20}", name):
                    self._feed.ask(TakeBack(name))
                case _:
                    return False


class Pages:
    """Answers requests with the token, in the link or in the cookie set by the link.

    The cookie is sent by pages of this site only (SameSite), so that no other site shows or watches the page.

    Attributes:
        encoder: compresses the images.
    """

    def __init__(self, token: str, feed: Feed) -> None:
        self.encoder = Encoder()
        self._token = token
        self._feed = feed
        self._viewers: set[Viewer] = set()
        folder = resources.files("lce_rig.show.phone") / "page"
        self._files = {entry.name: entry.read_bytes() for entry in folder.iterdir()}

    def application(self) -> web.Application:
        """Build the application."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        app.on_response_prepare.append(_add_headers)
        app.router.add_get("/live", self._live, allow_head=False)
        app.router.add_get("/", self._file)
        app.router.add_get("/{name}", self._file)
        return app

    async def close(self) -> None:
        """Send the pages the last state, and close them."""
        closing = (viewer.close() for viewer in self._viewers)
        await asyncio.gather(*closing, return_exceptions=True)
        self.encoder.close()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        tokens = (request.query.get("token", ""), request.cookies.get(self._cookie(request), ""))
        # In constant time, so that the response time does not reveal the correct part of a wrong token.
        if not any(
            hmac.compare_digest(text.encode(errors="replace"), self._token.encode()) for text in tokens
        ):
            text = "This page needs the whole link that lce-rig shows, with its token.\n"
            answer = web.Response(status=403, text=text)
            # Closing the connection limits strangers to the rate of new connections.
            answer.force_close()
            return answer
        origin = request.headers.get("Origin", f"http://{request.host}")
        if not _is_address(request.host) or origin != f"http://{request.host}":
            return web.Response(status=403, text="This page answers to its own address only.\n")
        return await handler(request)

    async def _file(self, request: web.Request) -> web.Response:
        name = request.match_info.get("name", "index.html")
        if name not in self._files:
            raise web.HTTPNotFound
        kind = _TYPES[name.rpartition(".")[2]]
        response = web.Response(body=self._files[name], content_type=kind, charset="utf-8")
        if "token" in request.query:
            # Lax: a link opened from another program or site must work at the first click.
            response.set_cookie(self._cookie(request), self._token, httponly=True, samesite="Lax", path="/")
        return response

    async def _live(self, request: web.Request) -> web.StreamResponse:
        line = web.WebSocketResponse(max_msg_size=MAX_MESSAGE_BYTES, timeout=GOODBYE_S)
        await line.prepare(request)
        viewer = Viewer(line, self._feed, self.encoder)
        self._viewers.add(viewer)
        try:
            await viewer.serve()
        finally:
            self._viewers.remove(viewer)
        return line

    @staticmethod
    def _cookie(request: web.Request) -> str:
        # Cookies are shared between the ports of a host.
        address = request.transport.get_extra_info("sockname") if request.transport else ("", 0)
        return f"{_COOKIE}_{address[1]}"


def _is_address(host: str) -> bool:
    """Return whether a Host names this computer by address or own name; other names may be rebound to it."""
    name = urlsplit(f"//{host}").hostname or ""
    own = socket.gethostname().lower()
    if name in ("localhost", own, f"{own}.local"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)
