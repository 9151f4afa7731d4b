"""The sensor's web page, over HTTP: whatever firmware answers."""

import json
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.devices.velodyne_web import find_problems, read_web
from tests.io.vlp16_room import settings

INFO = {
    "model": "VLP-16",
    "serial": "AG43510116",
    "mac_addr": "60-76-88-10-24-93",
    "version": {"gateware": {"id": "3.0.23.0"}, "application": {"id": "3.0.41.1", "date": "2018-05-01"}},
}
STATUS = {
    "gps": {"pps_state": "Locked", "position": "49 00.00N 200 .00W"},
    "motor": {"state": "On", "rpm": 599, "lock": "Off", "phase": 30755},
    "laser": {"state": "On"},
}
SETTINGS = {
    "rpm": 600,
    "returns": "Strongest",
    "laser": "On",
    "fov": {"start": 0, "end": 359},
    "host": {"addr": "255.255.255.255", "dport": 2368, "tport": 8308},
    "phaselock": {"enabled": "Off", "offset": 0},
}
PAGES: dict[str, Any] = {"info": INFO, "status": STATUS, "settings": SETTINGS}


@contextmanager
def serving(pages):
    """Serve a sensor's pages by name on a port; bytes are sent as they are."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            name = self.path.removeprefix("/cgi/").removesuffix(".json")
            if name not in pages:
                self.send_error(404)
                return
            content = pages[name]
            self.send_response(200)
            self.end_headers()
            self.wfile.write(content if isinstance(content, bytes) else json.dumps(content).encode())

        def log_message(self, format, *arguments):
            return

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def test_the_page_of_a_healthy_sensor_is_read_without_a_complaint():
    with serving(PAGES) as port:
        report = read_web("127.0.0.1", port)
    assert (report["model"], report["serial"], report["firmware"]) == ("VLP-16", "AG43510116", "3.0.41.1")
    assert (report["pps"], report["returns"], report["host"]) == ("locked", "strongest", "255.255.255.255")
    assert report["is_motor_on"] and report["is_laser_on"]
    assert report["rpm"] == 600
    assert (report["fov_deg"], report["data_port"], report["position_port"]) == ((0, 359), 2368, 8308)
    assert find_problems(report, settings()) == []


def test_types_that_differ_by_firmware_do_not_matter():
    odd = {
        "info": {"model": "VLP-16", "version": "3.0.29.0", "serial": 43510116},
        "status": {"gps": {"pps_state": "Locked"}, "motor": {"state": True, "rpm": "600"}},
        "settings": {
            "rpm": "600",
            "laser": "on",
            "returns": "STRONGEST",
            "fov": {"start": "0", "end": "359"},
        },
    }
    odd["settings"]["host"] = {"addr": "192.168.1.100", "dport": "2368", "tport": "8308"}
    with serving(odd) as port:
        report = read_web("127.0.0.1", port)
    assert (report["firmware"], report["serial"]) == ("3.0.29.0", "43510116")
    assert report["is_motor_on"] and report["is_laser_on"]
    assert (report["rpm"], report["returns"], report["data_port"]) == (600, "strongest", 2368)
    assert find_problems(report, settings()) == []


@pytest.mark.parametrize("body", [b"<html>router</html>", b"[1, 2]", b"\xff\xfe", b"", b"[" * 100_000])
def test_another_device_at_the_address_is_told_from_a_sensor(body):
    with serving({**PAGES, "info": body}) as port, pytest.raises(SourceError, match="cgi/info"):
        read_web("127.0.0.1", port)


def test_an_address_where_nothing_answers_is_an_error_with_what_to_check():
    with pytest.raises(SourceError, match=":9/") as caught:
        read_web("127.0.0.1", 9, 0.5)
    assert "192.168.1.x" in caught.value.hint
    with pytest.raises(SourceError):
        read_web("no such host")


WRONG: list[tuple[dict[str, Any], tuple[str, Any, Any]]] = [
    ({"info": {"model": "HDL-32E"}}, ("model", "HDL-32E", "VLP-16")),
    ({"status": {"motor": {"state": "Off"}}}, ("motor", "off", "on")),
    ({"status": {"laser": {"state": "Disabled"}}, "settings": {"laser": "Off"}}, ("laser", "off", "on")),
    ({"settings": {"rpm": 1200}}, ("rpm", 1200.0, 600.0)),
    ({"settings": {"fov": {"start": 270, "end": 90}}}, ("field of view", (270, 90), (0, 359))),
    ({"settings": {"host": {"dport": 2369}}}, ("data port", 2369, 2368)),
    ({"settings": {"host": {"tport": 8309}}}, ("telemetry port", 8309, 8308)),
    ({"status": {"gps": {"pps_state": "Absent"}}}, ("PPS", "absent", "locked")),
]


@pytest.mark.parametrize(("changes", "figures"), WRONG, ids=[figures[0] for _, figures in WRONG])
def test_what_keeps_scans_from_coming_is_found_with_its_figures(changes, figures):
    with serving({key: {**page, **changes.get(key, {})} for key, page in PAGES.items()}) as port:
        (problem,) = find_problems(read_web("127.0.0.1", port), settings())
    assert problem.code == "settings.differs"
    assert tuple(problem.figures[name] for name in ("setting", "value", "expected")) == figures
