"""A real browser, driven over the Chrome DevTools protocol."""

import asyncio
import base64
import itertools
import json
import subprocess
import time
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
from numpy.typing import NDArray

_START_S = 30.0
_ANSWER_S = 20.0
_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--mute-audio",
    "--hide-scrollbars", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip


class Browser:
    """A headless browser whose profile is an empty folder; closed at the end of its `with` block."""

    def __init__(self, executable: str, folder: Path) -> None:
        self._folder = folder
        command = [executable, *_FLAGS, f"--user-data-dir={folder}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._address = f"http://127.0.0.1:{self._port()}"
        self._pages: list[Page] = []
        self._loop = asyncio.new_event_loop()
        self._http = self._loop.run_until_complete(_http())

    def open(self, url: str, width: int = 1280, height: int = 720, first: str = "") -> "Page":
        """Open a page; `first` is run before its own scripts."""
        target = self._loop.run_until_complete(self._new_target())
        page = Page(self._loop, self._loop.run_until_complete(self._connect(target["webSocketDebuggerUrl"])))
        self._pages.append(page)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.resize(width, height)
        if first:
            page.call("Page.addScriptToEvaluateOnNewDocument", source=first)
        page.call("Page.navigate", url=url)
        page.wait_until("location.protocol !== 'about:' && document.readyState === 'complete'")
        return page

    def close_pages(self) -> None:
        """Close all pages; the browser stays."""
        for page in self._pages:
            page.call("Page.close")
            self._loop.run_until_complete(page.socket.close())
        self._pages.clear()

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.close_pages()
            self._loop.run_until_complete(self._http.close())
            self._loop.close()
        finally:
            self._end()

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _port(self) -> int:
        written = self._folder / "DevToolsActivePort"
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            lines = written.read_text().splitlines() if written.exists() else []
            if len(lines) == 2:
                return int(lines[0])
            time.sleep(0.05)
        self._end()
        raise RuntimeError("the browser did not start")

    async def _new_target(self) -> Any:
        async with self._http.put(f"{self._address}/json/new?about:blank") as answer:
            return await answer.json()

    async def _connect(self, url: str) -> aiohttp.ClientWebSocketResponse:
        return await self._http.ws_connect(url, max_msg_size=0)


class Page:
    """One open page.

    Attributes:
        complaints: errors that it raised or the browser logged about it.
        requested: addresses of everything that it loaded.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.complaints: list[str] = []
        self.requested: list[str] = []
        self.socket = socket
        self._loop = loop
        self._numbers = itertools.count(1)

    def call(self, method: str, **params: Any) -> Any:
        """Call a method of the protocol."""
        return self._loop.run_until_complete(asyncio.wait_for(self._call(method, params), _ANSWER_S))

    def resize(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def evaluate(self, expression: str) -> Any:
        """Give the value of an expression, as if it followed from a tap."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True, userGesture=True
        )
        if "exceptionDetails" in answer:
            raise AssertionError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def text(self, element: str) -> str:
        """Give the text of the element with this id."""
        return str(self.evaluate(f"document.getElementById({element!r})?.innerText ?? ''"))

    def wait_until(self, expression: str, timeout_s: float = 20.0) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + timeout_s
        while not self.evaluate(expression):
            assert time.monotonic() < deadline, (
                f"not true within {timeout_s} s: {expression}; {self.complaints}"
            )
            time.sleep(0.03)

    def tap(self, element: str) -> None:
        """Press the mouse on the middle of an element."""
        box = self.evaluate(
            f"(() => {{ const b = document.getElementById({element!r}).getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def screenshot(self) -> NDArray[np.uint8]:
        """Take a picture of the page, BGR."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        picture: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(picture, np.uint8)

    async def _call(self, method: str, params: dict[str, Any]) -> Any:
        number = next(self._numbers)
        await self.socket.send_str(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads((await self.socket.receive()).data)
            if message.get("id") == number:
                if "error" in message:
                    raise AssertionError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message.get("method"), message.get("params", {}))

    def _note(self, event: str | None, params: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            self.complaints.append(str(params["exceptionDetails"]))
        elif event == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.complaints.append(f"{params['entry']['source']}: {params['entry']['text']}")
        elif event == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.complaints.append(str(params["args"]))
        elif event == "Network.requestWillBeSent":
            self.requested.append(params["request"]["url"])


async def _http() -> aiohttp.ClientSession:
    return aiohttp.ClientSession()
