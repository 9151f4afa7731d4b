"""A viewer without a browser: HTTP and a WebSocket by hand, one call at a time."""

import asyncio
import json
from collections.abc import Mapping
from typing import Any

import aiohttp


class Watcher:
    """One client with separate cookies; closed at the end of its `with` block."""

    def __init__(self, url):
        self.url, _, query = url.partition("?")
        self._loop = asyncio.new_event_loop()
        self._http = self._run(_client())
        self.socket = None
        if query:
            self.get(f"?{query}")  # the link leaves a cookie

    def get(self, path="", headers=None):
        """Give status, headers and content."""

        async def ask() -> tuple[int, Mapping[str, str], bytes]:
            async with self._http.get(self.url + path, headers=headers) as answer:
                return answer.status, answer.headers, await answer.read()

        return self._run(ask())

    def watch(self, query="", headers=None):
        """Open the connection that feeds the page."""
        self.socket = self._run(
            self._http.ws_connect(f"{self.url}live{query}", headers=headers, max_msg_size=0)
        )

    def receive(self, timeout_s=60.0):
        """Return the next message: a document, bytes, or the code of the closed connection."""
        message = self._run(self.socket.receive(timeout_s))
        if message.type is aiohttp.WSMsgType.TEXT:
            return json.loads(message.data)
        if message.type is aiohttp.WSMsgType.BINARY:
            return message.data
        return message.data if message.type is aiohttp.WSMsgType.CLOSE else self.socket.close_code

    def receive_all(self, quiet_s):
        """Return messages, without beats, until none arrives for this time."""
        found = []
        while True:
            try:
                message = self.receive(quiet_s)
            except asyncio.TimeoutError:
                return found
            if isinstance(message, int):
                return found
            if not (isinstance(message, dict) and message.get("beat")):
                found.append(message)

    def next_state(self, visible=True):
        """Return the next state and its image, and acknowledge them."""
        while "beat" in (state := self.receive()):
            self.answer(visible)
        has_picture = state["drawing"] is not None and state["drawing"]["has_picture"]
        jpeg = self.receive() if has_picture else None
        self.answer(visible)
        return state, jpeg

    def answer(self, visible=True):
        self.send(json.dumps({"visible": visible}))

    def send(self, text):
        self._run(self.socket.send_str(text))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.socket is not None:
            self._run(self.socket.close())
        self._run(self._http.close())
        self._loop.close()

    def _run(self, work):
        async def within() -> Any:
            return await asyncio.wait_for(work, 120)

        return self._loop.run_until_complete(within())


async def _client() -> aiohttp.ClientSession:
    return aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))
