"""The web application: the page's files, and the connection that feeds it."""

import asyncio
import contextlib
import logging
from importlib import resources

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from lce_rig.collect.preview.access import Gate, guarded
from lce_rig.collect.preview.feed import Feed
from lce_rig.collect.preview.message import Encoder
from lce_rig.collect.preview.viewer import MAX_MESSAGE_BYTES, Viewer

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
# The page loads nothing from elsewhere, and nobody may frame it.
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def failures_log() -> logging.Logger:
    """Give the log of what goes wrong in the server itself; what strangers send wrongly is no news."""
    log = logging.getLogger("lce_rig.preview")
    log.addFilter(_is_own_failure)
    return log


class Server:
    """What answers requests.

    Attributes:
        encoder: compresses the pictures.
    """

    def __init__(self, gate: Gate, feed: Feed) -> None:
        self.encoder = Encoder()
        self._gate = gate
        self._feed = feed
        self._viewers: dict[Viewer, web.WebSocketResponse] = {}
        self._files = _page_files()

    def application(self) -> web.Application:
        """Build the application."""
        app = web.Application(middlewares=[guarded(self._gate)], client_max_size=1024)
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
            await viewer.serve()
        finally:
            del self._viewers[viewer]
        return socket


def _is_own_failure(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


def _page_files() -> dict[str, tuple[str, bytes]]:
    """Read the page's files: name -> (type, content)."""
    folder = resources.files("lce_rig.collect.preview") / "page"
    found = {}
    for entry in folder.iterdir():
        kind = _TYPES.get(entry.name.rpartition(".")[2])
        if kind is not None:
            found[entry.name] = (kind, entry.read_bytes())
    return found
