"""Connections that idle, flood or stop half way: the page goes on, and so does the collection."""

import contextlib
import socket
import time

import pytest

from lce_rig.show.phone import pages
from lce_rig.show.phone.pages import MAX_CONNECTIONS, Pages
from lce_rig.show.phone.preview import Preview

from .conftest import port_of, state
from .watcher import Watcher

HALF = {
    "nothing": b"",
    "headers": b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ",
    "a body": b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nx",
}


@contextlib.contextmanager
def connected(preview, n):
    with contextlib.ExitStack() as stack:
        lines = [stack.enter_context(socket.socket()) for _ in range(n)]
        for line in lines:
            line.settimeout(5)
            line.connect(("127.0.0.1", port_of(preview)))
        yield lines


def is_ended(line, within_s=0.0):
    line.settimeout(within_s)
    try:
        while line.recv(65536):
            pass
    except (BlockingIOError, TimeoutError):
        return False
    except ConnectionError:
        return True
    return True


def n_open(lines):
    return sum(not is_ended(line) for line in lines)


def test_strangers_have_so_many_connections_and_for_so_long(monkeypatch):
    monkeypatch.setattr(pages, "CONNECTION_S", 1.5)
    with Preview(port=0) as preview, Watcher(preview.urls[0]) as early:
        early.watch()
        with connected(preview, MAX_CONNECTIONS + 20) as lines:
            for n_most in (MAX_CONNECTIONS, 0):
                deadline_s = time.monotonic() + 8
                while n_open(lines) > n_most:
                    assert time.monotonic() < deadline_s
                    time.sleep(0.05)
            # An open page is kept, and there is room for another.
            preview.publish(state())
            assert early.next_state()[0]["n_captures"] == 7
            with Watcher(preview.urls[0]) as late:
                assert late.get()[0] == 200


@pytest.mark.parametrize("sent", HALF.values(), ids=HALF)
def test_what_is_sent_half_ends_in_time(monkeypatch, sent):
    monkeypatch.setattr(pages, "CONNECTION_S", 0.5)
    with Preview(port=0) as preview, connected(preview, 1) as (line,):
        line.sendall(sent)
        began_s = time.monotonic()
        while not is_ended(line, 0.05):
            assert time.monotonic() < began_s + 8
            with contextlib.suppress(OSError):
                line.sendall(b"x" if sent else b"")


def test_a_page_that_shows_nothing_makes_way(preview, monkeypatch):
    monkeypatch.setattr(pages, "ANSWER_S", 0.3)
    with Watcher(preview.urls[0]) as asleep, Watcher(preview.urls[0]) as awake:
        asleep.watch()
        awake.watch()
        for _ in range(6):
            preview.publish(state())
            awake.next_state()
            time.sleep(0.1)
        assert any(isinstance(asleep.receive(), int) for _ in range(6))


def test_a_page_that_fails_altogether_ends_alone(monkeypatch, caplog):
    def broken(_pages):
        raise RuntimeError("broken")

    monkeypatch.setattr(Pages, "application", broken)
    with Preview(port=0) as preview:
        preview.publish(state())
    (note,) = preview.notes()
    assert "has ended" in note and "RuntimeError('broken')" in note
    assert len(caplog.records) == 1
