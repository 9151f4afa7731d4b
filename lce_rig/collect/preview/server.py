"""The web application: the page's files, and the connection that feeds it."""

import asyncio
import contextlib
from importlib import resources

from aiohttp import web

from lce_rig.collect.preview.access import Gate, guarded
from lce_rig.collect.preview.connections import Connections
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
    folder = resources.files("lce_rig.collect.preview") / "page"
    found = {}
    for entry in folder.iterdir():
        kind = _TYPES.get(entry.name.rpartition(".")[2])
        if kind is not None:
            found[entry.name] = (kind, entry.read_bytes())
    return found
