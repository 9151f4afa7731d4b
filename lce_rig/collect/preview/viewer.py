"""One open page: told the newest state as fast as it can follow, and no faster."""

import asyncio
import contextlib
import json
import time

from aiohttp import WSMsgType, web

from lce_rig.collect.live.state import LiveState
from lce_rig.collect.preview import message
from lce_rig.collect.preview.feed import Feed

#: Between two updates.
PERIOD_S = 0.1
#: Without news the page is told so this often, and so knows that it is still connected.
BEAT_S = 1.0
#: Updates under way to a page. Two hide the time of their way; more would only grow old in buffers.
MAX_UNDER_WAY = 2
MAX_MESSAGE_BYTES = 256
#: A page that shows no update for so long sleeps; it connects again when it wakes.
ANSWER_S = 5.0


class Viewer:
    """Feeds one connection.

    The page answers each update with its number once it is on the screen, and images are sent to pages that
    are looked at. Nothing else is read from it.
    """

    def __init__(self, socket: web.WebSocketResponse, feed: Feed, encoder: message.Encoder) -> None:
        self._socket = socket
        self._feed = feed
        self._encoder = encoder
        self._n_sent = 0
        self._n_shown = 0
        self._is_looked_at = True
        self._state = 0
        self._delivered = 0
        self._pixels: message.Pixels | None = None
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
                await self._socket.close(code=1008, message=b"only answers to updates are read")
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
                    await self._socket.send_str(message.beat(self._feed.age_s()))

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
        await self._socket.send_str(message.to_json(state, self._n_sent, has_picture=jpeg is not None))
        if jpeg is not None:
            await self._socket.send_bytes(jpeg)

    def _take(self, text: str) -> bool:
        """Take an answer: {"shown": update, "visible": bool}; False where it is none."""
        try:
            answer = json.loads(text)
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
