"""Hostile connections to the preview page of a live collection: it goes on and saves captures."""

import asyncio
import contextlib
import json
import random
import re
import resource
import selectors
import signal
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import aiohttp
from wire.collecting import Collecting
from wire.reel import make_reel
from wire.rig import WireRig, small_rig

from fuzzing.report import Report
from lce_rig.core.errors import SessionError
from lce_rig.session import Session

N_DESCRIPTORS = 1024
MAX_LOG_BYTES = 100_000
_MAX_OPEN = 2000
_PER_TICK, _TICK_S = 40, 0.1
_PAGE_S = 5.0
# Its limit of 48, some that end just then, and what else comes and goes in a collection.
_MAX_OF_PAGE = 80
_LOOPS_PER_HOLD = 3
_PRELUDE = f"import resource; resource.setrlimit(resource.RLIMIT_NOFILE, ({N_DESCRIPTORS}, {N_DESCRIPTORS}))"


@dataclass
class PreviewReport(Report):
    """What became of the collection.

    Attributes:
        kinds: how many of each kind.
        n_open: most that were held open at once by the hostile end.
        n_pages: honest pages opened meanwhile.
        n_again: how often one had to be loaded again.
        slowest_page_s: the slowest of them, from the connection to its first state.
        n_captures: saved meanwhile.
        n_descriptors: most that the collection had open.
        log_bytes: written to its terminal.
    """

    kinds: Counter[str] = field(default_factory=Counter)
    n_open: int = 0
    n_pages: int = 0
    n_again: int = 0
    slowest_page_s: float = 0.0
    n_captures: int = 0
    n_descriptors: int = 0
    log_bytes: int = 0


def fuzz_preview(n: int, seed: int) -> PreviewReport:
    """Make n hostile connections to the page of a collection that may have 1,024 descriptors open.

    Up to 2,000 from eight addresses are held at once; honest pages are opened meanwhile from one of these.
    The sensors send over UDP and a pipe.

    Args:
        n: how many.
        seed: same seed, same kinds in the same order.
    """
    report, began_s = PreviewReport(), time.monotonic()
    _allow_descriptors()
    with tempfile.TemporaryDirectory() as folder:
        rig = small_rig(is_guided=False)
        reel = make_reel(Path(folder) / "reel", rig, n_placements=4)
        session = Path(folder) / "session"
        options = ("--hold", "0", "--preview", f"0.0.0.0:{_free_port()}")
        with (
            WireRig(Path(folder), rig, reel, _LOOPS_PER_HOLD) as wire,
            Collecting(wire.profile, session, *options, prelude=_PRELUDE) as collecting,
        ):
            collecting.wait_for_captures(1, 120)
            link = re.search(r"preview: http://[^:]*:(\d+)/\?token=(\S+)", collecting.said)
            assert link is not None, collecting.said
            port, token = int(link[1]), link[2]
            _attack(report, collecting, port, token, n, random.Random(seed))
            _end(report, collecting, session)
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


class _Hostile:
    """One connection of a kind: what it sends, piece by piece, one a tick."""

    def __init__(self, port: int, peer: str, pieces: Iterator[bytes], *, is_deaf: bool = False) -> None:
        self.line = socket.socket()
        self._pieces = pieces
        if is_deaf:
            self.line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        self.line.bind((peer, 0))
        self.line.setblocking(False)
        self.line.connect_ex(("127.0.0.1", port))

    def go_on(self) -> None:
        """Send the next piece where there is one and the line takes it."""
        with selectors.DefaultSelector() as selector:
            selector.register(self.line, selectors.EVENT_WRITE)
            if not selector.select(0):
                return
        # Refused and ended connections are what is wanted of the other end.
        with contextlib.suppress(OSError):
            self.line.send(next(self._pieces, b""))


def _attack(
    report: PreviewReport, collecting: Collecting, port: int, token: str, n: int, chance: random.Random
) -> None:
    before, early_bytes, next_page_s = collecting.n_captures, 0, 0.0
    most = _n_descriptors(collecting.pid) + _MAX_OF_PAGE
    hostile: list[_Hostile] = []
    try:
        while report.n < n and _is_running(report, collecting):
            for _ in range(min(_PER_TICK, n - report.n)):
                if len(hostile) >= _MAX_OPEN:
                    hostile.pop(chance.randrange(len(hostile))).line.close()
                kind = chance.choice(list(_KINDS))
                pieces = _KINDS[kind](port, token, chance)
                peer = f"127.0.0.{chance.randint(1, 8)}"
                hostile.append(_Hostile(port, peer, pieces, is_deaf=kind == "slow reader"))
                report.n += 1
                report.kinds[kind] += 1
            for each in hostile[-400:]:
                each.go_on()
            report.n_open = max(report.n_open, len(hostile))
            report.n_descriptors = max(report.n_descriptors, _n_descriptors(collecting.pid))
            if time.monotonic() > next_page_s:
                _open_page(report, port, token)
                next_page_s = time.monotonic() + 1.0
            if not early_bytes and report.n > n // 10:
                early_bytes = _resident_bytes(collecting.pid)
            time.sleep(_TICK_S)
        # What is open now stays open while captures go on.
        saved = collecting.n_captures
        collecting.wait_for_captures(saved + 2, 60)
        _open_page(report, port, token)
    except AssertionError as error:
        report.wrong.append(f"the collection does not go on: {error}")
    finally:
        for each in hostile:
            each.line.close()
    report.n_captures = collecting.n_captures - before
    if report.n_descriptors > most:
        report.wrong.append(f"{report.n_descriptors} descriptors were open, at most {most} are expected")
    if early_bytes:
        report.grown_bytes = _resident_bytes(collecting.pid) - early_bytes


def _is_running(report: PreviewReport, collecting: Collecting) -> bool:
    if Path(f"/proc/{collecting.pid}/fd").exists() and _n_descriptors(collecting.pid):
        return True
    report.wrong.append(f"the collection has ended: {collecting.said[-2000:]}")
    return False


def _end(report: PreviewReport, collecting: Collecting, session: Path) -> None:
    """End it, and judge what it has said and kept."""
    code, said = collecting.end(signal.SIGTERM), collecting.said
    report.log_bytes = len(said.encode())
    if code != 0:
        report.wrong.append(f"it ended with {code}: {said[-2000:]}")
    if report.log_bytes > MAX_LOG_BYTES:
        report.wrong.append(f"its log has {report.log_bytes} bytes")
    if "Traceback" in said:
        report.wrong.append(said[said.index("Traceback") :][:2000])
    for capture in Session.open(session).captures:
        try:
            capture.check()
        except SessionError as error:
            report.wrong.append(str(error))
    print(*[line for line in said.splitlines() if "preview: " in line], sep="\n", file=sys.stderr)


def _open_page(report: PreviewReport, port: int, token: str) -> None:
    """Open the page as a person does, who loads it again where it does not come, and wait for a state."""

    async def ask() -> None:
        url = f"http://127.0.0.1:{port}/"
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            for path in (f"?token={token}", "page.js", "page.css"):
                async with http.get(url + path) as answer:
                    answer.raise_for_status()
                    await answer.read()
            async with http.ws_connect(url + "live", max_msg_size=0) as line:
                assert "headline" in json.loads((await line.receive()).data)

    began_s, is_open = time.monotonic(), False
    while not is_open and time.monotonic() < began_s + _PAGE_S:
        try:
            asyncio.run(asyncio.wait_for(ask(), began_s + _PAGE_S - time.monotonic()))
            is_open = True
        except (aiohttp.ClientError, asyncio.TimeoutError, OSError) as error:
            report.n_again += 1
            failure = f"a page could not be opened after {report.n} connections: {type(error).__name__}"
            time.sleep(_TICK_S)
    if not is_open:
        report.wrong.append(failure)
    report.n_pages += 1
    report.slowest_page_s = max(report.slowest_page_s, round(time.monotonic() - began_s, 2))


def _idle(_port: int, _token: str, _chance: random.Random) -> Iterator[bytes]:
    yield from ()


def _half_sent(port: int, token: str, chance: random.Random) -> Iterator[bytes]:
    request = _request(port, token)
    yield request[: chance.randrange(1, len(request))]


def _trickle(port: int, token: str, _chance: random.Random) -> Iterator[bytes]:
    for byte in _request(port, token):
        yield bytes([byte])


def _body(port: int, token: str, _chance: random.Random) -> Iterator[bytes]:
    yield _request(port, token, "Content-Length: 1000000000") + b"x"
    while True:
        yield b"x"


def _garbage(_port: int, _token: str, chance: random.Random) -> Iterator[bytes]:
    yield chance.randbytes(chance.randrange(1, 3000))


def _wrong_token(port: int, _token: str, chance: random.Random) -> Iterator[bytes]:
    while True:
        yield _request(port, chance.randbytes(6).hex()) * chance.randrange(1, 20)


def _huge_headers(port: int, token: str, chance: random.Random) -> Iterator[bytes]:
    yield _request(port, token, "X: " + "a" * chance.randrange(100, 200_000))
    yield _request(port, token, *(f"X-{k}: a" for k in range(1000)))


def _junk_messages(port: int, token: str, chance: random.Random) -> Iterator[bytes]:
    yield _upgrade(port, _seldom(token, chance))
    yield chance.randbytes(chance.randrange(1, 500))


def _slow_reader(port: int, token: str, chance: random.Random) -> Iterator[bytes]:
    yield _upgrade(port, _seldom(token, chance))


def _seldom(token: str, chance: random.Random) -> str:
    """Give the right token seldom: many who have it may take all places for pages."""
    return token if chance.random() < 0.03 else "wrong-token"


def _request(port: int, token: str, *headers: str) -> bytes:
    lines = (f"GET /?token={token} HTTP/1.1", f"Host: 127.0.0.1:{port}", *headers)
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def _upgrade(port: int, token: str) -> bytes:
    lines = (
        f"GET /live?token={token} HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
    )
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


_KINDS: dict[str, Callable[[int, str, random.Random], Iterator[bytes]]] = {
    "idle": _idle,
    "half sent": _half_sent,
    "one byte at a time": _trickle,
    "body without end": _body,
    "garbage": _garbage,
    "wrong token": _wrong_token,
    "huge headers": _huge_headers,
    "junk messages": _junk_messages,
    "slow reader": _slow_reader,
}


def _allow_descriptors() -> None:
    """Let this process hold the hostile ends of all connections."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MAX_OPEN + 500
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, max(hard, wanted)))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def _n_descriptors(pid: int) -> int:
    with contextlib.suppress(OSError):
        return sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return 0


def _resident_bytes(pid: int) -> int:
    with contextlib.suppress(OSError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()
    return 0
