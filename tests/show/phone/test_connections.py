"""Connections that idle, flood or stop half way: the page goes on, and so does what collects."""

import contextlib
import errno
import os
import resource
import socket
import time
from collections.abc import Iterator

import pytest

from lce_rig.show.phone import Preview, connections
from lce_rig.show.phone import preview as page_module
from lce_rig.show.phone.connections import MAX_CONNECTIONS, MAX_OF_ONE_PEER
from lce_rig.show.phone.preview import Server
from tests.notes import has_note

from .conftest import state
from .watcher import Watcher

HALF = {
    "nothing": b"",
    "headers": b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ",
    "a body": b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nx",
}


def port_of(preview: Preview) -> int:
    return int(preview.urls[0].rstrip("/").rpartition(":")[2])


@contextlib.contextmanager
def connected(preview: Preview, n: int, peer: str = "127.0.0.1") -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        lines = [stack.enter_context(socket.socket()) for _ in range(n)]
        for line in lines:
            line.bind((peer, 0))
            line.settimeout(5)
            line.connect(("127.0.0.1", port_of(preview)))
        yield lines


def is_ended(line: socket.socket, within_s: float = 0.0) -> bool:
    line.settimeout(within_s)
    try:
        while line.recv(65536):
            pass
    except (BlockingIOError, TimeoutError):
        return False
    except ConnectionError:
        return True
    return True


def n_open(lines: list[socket.socket]) -> int:
    return sum(not is_ended(line) for line in lines)


def wait_for_note(preview: Preview, text: str) -> None:
    deadline_s = time.monotonic() + 5
    while not any(text in note for note in preview.notes()):
        assert time.monotonic() < deadline_s, preview.notes()
        time.sleep(0.02)


def test_one_address_has_a_few_connections_and_all_together_a_few_dozen(preview: Preview) -> None:
    with connected(preview, 40) as first, connected(preview, 40, "127.0.0.2") as second:
        wait_for_note(preview, f"{80 - 2 * MAX_OF_ONE_PEER} connections refused")
        time.sleep(0.1)
        assert n_open(first) == n_open(second) == MAX_OF_ONE_PEER
        with connected(preview, 40, "127.0.0.3") as third, connected(preview, 4, "127.0.0.4") as fourth:
            wait_for_note(preview, f"{124 - MAX_CONNECTIONS} connections")
            time.sleep(0.1)
            assert n_open(first + second + third + fourth) <= MAX_CONNECTIONS


def test_who_opens_many_and_says_nothing_keeps_nobody_out(preview: Preview) -> None:
    preview.publish(state())
    with connected(preview, 3 * MAX_OF_ONE_PEER), Watcher(preview.urls[0]) as watcher:
        time.sleep(0.7)
        assert watcher.get()[0] == 200
        watcher.watch()
        assert watcher.next_state()[0]["n_captures"] == 7
        assert has_note(preview.notes(), "make room")


@pytest.mark.parametrize("sent", HALF.values(), ids=HALF)
def test_what_is_sent_half_ends_in_time_and_an_open_page_does_not(
    preview: Preview, monkeypatch: pytest.MonkeyPatch, sent: bytes
) -> None:
    monkeypatch.setattr(connections, "REQUEST_S", 0.4)
    monkeypatch.setattr(connections, "_SWEEP_S", 0.1)
    with Watcher(preview.urls[0]) as page:
        page.watch()
        # The sweep that was planned before takes the old pace once.
        with connected(preview, 1) as (line,):
            line.sendall(sent)
            began_s = time.monotonic()
            while not is_ended(line, 0.05):
                assert time.monotonic() < began_s + 3
                with contextlib.suppress(OSError):
                    line.sendall(b"x" if sent else b"")
        preview.publish(state())
        assert page.next_state()[0]["n_captures"] == 7


def test_a_page_that_shows_nothing_makes_way(preview: Preview, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "ANSWER_S", 0.3)
    with Watcher(preview.urls[0]) as asleep, Watcher(preview.urls[0]) as awake:
        asleep.watch()
        awake.watch()
        for _ in range(6):
            preview.publish(state())
            awake.next_state()
            time.sleep(0.1)
        assert any(isinstance(asleep.receive(), int) for _ in range(6))


def test_descriptors_stay_free_for_captures(preview: Preview) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (connections.RESERVED_DESCRIPTORS + 5, hard))
        with connected(preview, 3) as lines:
            assert all(is_ended(line, 3) for line in lines)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert has_note(preview.notes(), "3 connections refused")
    with Watcher(preview.urls[0]) as watcher:
        assert watcher.get()[0] == 200


def test_without_descriptors_the_page_waits_and_says_so_once(
    preview: Preview, caplog: pytest.LogCaptureFixture
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as line:
        line.settimeout(5)
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))  # 0 to 2 are in use
            line.connect(("127.0.0.1", port_of(preview)))
            time.sleep(1.3)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        line.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert line.recv(100).startswith(b"HTTP/1.1 200")
    (record,) = caplog.records
    assert os.strerror(errno.EMFILE) in record.getMessage()
    assert has_note(preview.notes(), os.strerror(errno.EMFILE), "2 times")


def test_a_page_that_fails_altogether_ends_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_server: Server) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(Server, "application", broken)
    with Preview(port=0) as preview:
        preview.publish(state())
    (note,) = preview.notes()
    assert "has ended" in note and "RuntimeError('broken')" in note
    assert len(caplog.records) == 1


def test_a_failure_that_repeats_is_logged_once(preview: Preview, caplog: pytest.LogCaptureFixture) -> None:
    preview.publish(state(notes=object()))
    for _ in range(5):
        with Watcher(preview.urls[0]) as watcher:
            watcher.watch()
            assert isinstance(watcher.receive(), int)
    assert len(caplog.records) == 1
    assert preview.notes()[0].endswith("(5 times)")
