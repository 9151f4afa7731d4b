import json
import socket
import statistics
import threading
import time

import cv2
import numpy as np
import pytest

from lce_rig.collect.live.state import Drawing
from lce_rig.show.phone.preview import Preview

from .conftest import PRESENT_PX, picture, port_of, state
from .watcher import Watcher

pytestmark = pytest.mark.realtime


def ask_for_states(port, query):
    return (
        f"GET /live?{query} HTTP/1.1\r\nHost: localhost:{port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )


def test_all_of_a_state_arrives(preview):
    present = PRESENT_PX + 0.04
    present[1] = np.nan
    sent = state(sigma_deg=float("nan"), drawing=Drawing("cam", picture(), present, None, True), hold_s=1.5)
    preview.publish(sent)
    with Watcher(preview.urls[0]) as watcher:
        watcher.watch()
        got, jpeg = watcher.next_state()
    assert (got["phase"], got["headline"], got["hold_s"]) == ("moving", sent.headline, 1.5)
    assert (got["n_captures"], got["n_wanted"], got["elapsed_s"]) == (7, 15, 83.4)
    assert (got["sigma_deg"], got["sigma_mm"], got["target_deg"], got["target_mm"]) == (None, 4.0, 0.1, 5.0)
    assert got["coverage"] == {"left_right": 0.8, "up_down": 0.4, "near_far": 0.6, "tilt": 0.5, "roll": 1.0}
    assert got["streams"][1] == {
        "name": "lidar", "rate_hz": 10.0, "n_lost": 3, "sees_board": False,
        "reason": sent.streams[1].reason, "figures": "",
    }  # fmt: skip
    assert got["cues"] == [{"number": 1, "sound": "tick"}, {"number": 2, "sound": "captured"}]
    assert (got["log"], got["notes"]) == (["captured 000005", "captured 000006"], list(sent.notes))
    drawing = got["drawing"]
    assert (drawing["width_px"], drawing["height_px"], drawing["is_there"]) == (640, 360, True)
    assert drawing["present_px"] == [[100.0, 80.0], None, [200.0, 180.0], [100.0, 180.0], [100.0, 80.0]]
    assert drawing["wanted_px"] is None
    assert jpeg is not None
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded.astype(int) - picture()).mean() < 1


def test_feed_stuck_page_delays_nothing(preview):
    big = [np.random.default_rng(k).integers(0, 255, (720, 1280, 3), np.uint8) for k in range(5)]
    with Watcher(preview.urls[0]) as stuck, Watcher(preview.urls[0]) as quick:
        stuck.watch()
        quick.watch()
        took_s, shown = [], 0
        for k in range(40):
            moment = state(n_captures=k, drawing=Drawing("cam", big[k % 5]))
            began_s = time.perf_counter()
            preview.publish(moment)
            took_s.append(time.perf_counter() - began_s)
            if k % 8 == 7:
                shown = quick.next_state()[0]["n_captures"]
            time.sleep(0.01)
        while shown < 39:
            shown = quick.next_state()[0]["n_captures"]
        assert statistics.median(took_s) < 10e-3
        got = stuck.receive_all(quiet_s=0.5)
        assert sum(isinstance(message, dict) for message in got) <= 1


def test_a_page_asks_for_the_capture_it_shows_as_the_last(preview):
    with Watcher(preview.urls[0]) as watcher:
        watcher.watch()
        preview.publish(state(last_capture="000006"))
        assert watcher.next_state()[0]["last_capture"] == "000006"
        assert preview.asked() is None
        for name in ("000006", "000005"):
            watcher.send(json.dumps({"take_back": name}))
        deadline_s, asked = time.monotonic() + 60, list[str]()
        while len(asked) < 2:
            assert time.monotonic() < deadline_s
            if (each := preview.asked()) is not None:
                asked.append(each.name)
        assert asked == ["000006", "000005"]


@pytest.mark.parametrize(
    "text",
    ["", "no json", "[]", "{}", '{"visible": 1}', "true", "[" * 200, "x" * 5000,
     '{"take_back": 6}', '{"take_back": "../../etc"}', '{"take_back": ""}', "7", '"take_back"'],
)  # fmt: skip
def test_invalid_message_ends_only_its_connection(preview, text):
    with Watcher(preview.urls[0]) as odd, Watcher(preview.urls[0]) as other:
        odd.watch()
        odd.send(text)
        while isinstance(closed := odd.receive(), dict):
            assert "beat" in closed
        assert closed in (1008, 1009)
        preview.publish(state())
        other.watch()
        assert other.next_state()[0]["n_captures"] == 7


def test_port_noise_is_ignored(preview, caplog):
    port = port_of(preview)
    random = np.random.default_rng(1)
    said = [random.bytes(300) for _ in range(20)]
    said += [
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET /" + 100_000 * b"a" + b" HTTP/1.1\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01",
    ]
    for each in said:
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(each)
            client.shutdown(socket.SHUT_WR)
            assert not client.recv(4096).startswith(b"HTTP/1.1 200")
    with Watcher(preview.urls[0]) as watcher:
        assert watcher.get()[0] == 200
    assert not caplog.records


def test_pages_have_the_last_state_when_the_collection_ends():
    preview = Preview(port=0)
    with Watcher(preview.start()) as watcher:
        watcher.watch()
        preview.publish(state(n_captures=0))
        watcher.next_state()
        for k in range(1, 5):
            preview.publish(state(n_captures=k))
        preview.publish(state(phase="ended", n_captures=9))
        closer = threading.Thread(target=preview.close)
        closer.start()
        seen = [json.dumps(message) for message in watcher.receive_all(30.0) if isinstance(message, dict)]
        closer.join(60)
        assert not closer.is_alive()
    assert '"phase": "ended"' in seen[-1]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("preview")]
    preview.publish(state())
    preview.close()


def test_closing_does_not_wait_for_stuck_pages():
    preview = Preview(port=0)
    query = preview.start().partition("?")[2]
    port = port_of(preview)
    noise = np.random.default_rng(1).integers(0, 255, (3000, 960, 3), np.uint8)
    with socket.socket() as full:
        full.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        full.connect(("127.0.0.1", port))
        full.sendall(ask_for_states(port, query))
        preview.publish(state(drawing=Drawing("cam", noise)))
        while not preview.n_pictures:
            time.sleep(0.02)
        preview.close()
        # Its thread has ended too, and left no connection behind.
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("preview")]
