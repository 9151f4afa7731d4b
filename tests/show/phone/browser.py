"""A real browser, driven over the Chrome DevTools protocol."""

import asyncio
import base64
import itertools
import json
import subprocess
import time
from typing import Any

import aiohttp
import cv2
import numpy as np

_START_S = 120.0
_ANSWER_S = 60.0
_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-audio-output", "--hide-scrollbars", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--remote-debugging-port=0",
    "--remote-allow-origins=*",
)  # fmt: skip


class Browser:
    """A headless browser; closed at the end of its `with` block.

    Each page has a context of its own, in memory: what one keeps, no other sees, and no slow disk delays it.
    """

    def __init__(self, executable, folder):
        """Start it with an empty folder as its profile."""
        self._folder = folder
        command = [executable, *_FLAGS, f"--user-data-dir={folder}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        port, path = self._address()
        self._url = f"ws://127.0.0.1:{port}"
        self._contexts = []
        self._loop = asyncio.new_event_loop()
        self._http = self._loop.run_until_complete(_http())
        self._line = Line(self._loop, self._connect(path))

    def open(self, url, width=1280, height=720, first=""):
        """Open a page; `first` runs before the page's scripts."""
        context = self._line.call("Target.createBrowserContext")["browserContextId"]
        target = self._line.call("Target.createTarget", url="about:blank", browserContextId=context)
        page = Page(self._loop, self._connect(f"/devtools/page/{target['targetId']}"))
        self._contexts.append((context, page))
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.resize(width, height)
        if first:
            page.call("Page.addScriptToEvaluateOnNewDocument", source=first)
        page.call("Page.navigate", url=url)
        page.wait_until("location.protocol !== 'about:' && document.readyState === 'complete'")
        return page

    def close_pages(self):
        """Close all pages; the browser stays."""
        for context, page in self._contexts:
            page.close()
            self._line.call("Target.disposeBrowserContext", browserContextId=context)
        self._contexts.clear()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.close_pages()
            self._line.close()
            self._loop.run_until_complete(self._http.close())
            self._loop.close()
        finally:
            self._end()

    def _end(self):
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _address(self):
        written = self._folder / "DevToolsActivePort"
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            lines = written.read_text().splitlines() if written.exists() else []
            if len(lines) == 2:
                return int(lines[0]), lines[1]
            time.sleep(0.05)
        self._end()
        raise RuntimeError("the browser did not start")

    def _connect(self, path):
        return self._loop.run_until_complete(_connect(self._http, self._url + path))


class Line:
    """A connection that takes commands."""

    def __init__(self, loop, socket):
        self._loop = loop
        self._socket = socket
        self._numbers = itertools.count(1)

    def call(self, method, **params):
        """Call a method of the protocol."""
        return self._loop.run_until_complete(asyncio.wait_for(self._call(method, params), _ANSWER_S))

    def close(self):
        self._loop.run_until_complete(self._socket.close())

    async def _call(self, method: str, params: dict[str, Any]) -> Any:
        number = next(self._numbers)
        await self._socket.send_str(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads((await self._socket.receive()).data)
            if message.get("id") == number:
                if "error" in message:
                    raise AssertionError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message.get("method"), message.get("params", {}))

    def _note(self, event, params):
        """Take what came unasked."""


class Page(Line):
    """One open page."""

    def __init__(self, loop, socket):
        super().__init__(loop, socket)
        self.complaints = []
        self.requested = []

    def resize(self, width, height):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def evaluate(self, expression):
        """Return the value of an expression, evaluated as if after a tap."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True, userGesture=True
        )
        if "exceptionDetails" in answer:
            raise AssertionError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def _describe(self, expression):
        where = self.evaluate("`${location.href}, ${document.readyState}`")
        return f"not true: {expression}; {where}; loaded {self.requested}; {self.complaints}"

    def text(self, element):
        """Return the text of the element with this id."""
        return str(self.evaluate(f"document.getElementById({element!r})?.innerText ?? ''"))

    def each(self, selector, name="id"):
        """Return a property of every element that a selector matches."""
        found = f"[...document.querySelectorAll({selector!r})].map((each) => each[{name!r}])"
        return [str(value) for value in self.evaluate(found)]

    def wait_until(self, expression, timeout_s=120.0):
        """Wait until an expression is true."""
        deadline = time.monotonic() + timeout_s
        while not self.evaluate(expression):
            assert time.monotonic() < deadline, self._describe(expression)
            time.sleep(0.03)

    def tap(self, element):
        """Press the mouse on the middle of an element."""
        box = self.evaluate(
            f"(() => {{ const b = document.getElementById({element!r}).getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def screenshot(self):
        """Take a screenshot of the page, BGR."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(picture, np.uint8)

    def _note(self, event, params):
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


async def _connect(http: aiohttp.ClientSession, url: str) -> aiohttp.ClientWebSocketResponse:
    return await http.ws_connect(url, max_msg_size=0)
