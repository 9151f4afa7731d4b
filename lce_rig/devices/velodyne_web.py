"""The web page of a Velodyne: what it is, how it does and how it is set.

Firmware differs in what it tells and in the types of its values: every field may be missing, numbers come as
text, switches as "On", "on" or true.

References:
    VLP-16 User Manual, Velodyne 63-9243 Rev. D, chapter 8 and appendix on curl commands.
"""

import json
import math
from dataclasses import dataclass
from http.client import HTTPException
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import ProxyHandler, build_opener

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.rig import LidarSettings

_TIMEOUT_S = 2.0
_MAX_BODY_BYTES = 1 << 20
# A sensor in the field of a proxy is still a neighbour on the cable.
_OPENER = build_opener(ProxyHandler({}))


@dataclass(frozen=True)
class WebReport:
    """What the web page says; fields are "" or None where it does not.

    Attributes:
        model, serial, firmware: of the sensor.
        pps: "absent", "synchronizing", "locked" or "error".
        is_motor_on, is_laser_on: whether they run.
        rotor_hz: measured speed.
        wanted_rotor_hz: speed that is set.
        returns: "strongest", "last" or "dual".
        fov_deg: first and last azimuth that is sent.
        host: address that packets are sent to; 255.255.255.255 is everybody.
        data_port, position_port: UDP ports they are sent to.
        temperature_c: of the hotter board.
    """

    model: str = ""
    serial: str = ""
    firmware: str = ""
    pps: str = ""
    is_motor_on: bool | None = None
    is_laser_on: bool | None = None
    rotor_hz: float | None = None
    wanted_rotor_hz: float | None = None
    returns: str = ""
    fov_deg: tuple[float, float] | None = None
    host: str = ""
    data_port: int | None = None
    position_port: int | None = None
    temperature_c: float | None = None


class VelodyneWeb:
    """The web server of one sensor.

    Attributes:
        url: its root.
        port: of the server.
    """

    def __init__(self, address: str, port: int = 80, timeout_s: float = _TIMEOUT_S) -> None:
        self.url = f"http://{address}" + (f":{port}" if port != 80 else "")
        self.port = port
        self._timeout_s = timeout_s

    def read(self) -> WebReport:
        """Read info, status, settings and diagnostics; nothing is changed.

        Raises:
            SourceError: nothing answers, or what answers is no Velodyne.
        """
        info, status = self._get("info"), self._get("status")
        settings = self._get("settings")
        try:
            diagnostics = self._get("diag")
        except SourceError:  # Not every firmware has them.
            diagnostics = {}
        return to_report(info, status, settings, diagnostics)

    def read_serial(self) -> str:
        """Read the serial number alone; "" where the page does not tell it.

        Raises:
            SourceError: nothing answers, or what answers is no Velodyne.
        """
        return _text(self._get("info"), "serial")

    def _get(self, page: str) -> dict[str, Any]:
        body = self._request(f"/cgi/{page}.json")
        try:
            content = json.loads(body)
        except (ValueError, RecursionError):  # Also where it is no UTF-8.
            content = None
        if not isinstance(content, dict):
            hint = "Is driver.address the LiDAR's? Another device may have that address."
            raise SourceError(f"{self.url}/cgi/{page}.json is not what a Velodyne answers", hint)
        return content

    def _request(self, path: str) -> bytes:
        try:
            with _OPENER.open(self.url + path, timeout=self._timeout_s) as response:
                return bytes(response.read(_MAX_BODY_BYTES))
        except (URLError, HTTPException, OSError, ValueError) as error:
            if isinstance(error, HTTPError):
                error.close()  # it is an open answer, too
            cause = getattr(error, "reason", None) or error
            raise SourceError(
                f"{self.url}{path} does not answer: {cause}",
                "Check cable and power, and that this computer has an address in the LiDAR's network "
                "(192.168.1.x, mask 255.255.255.0).",
            ) from None


def to_report(
    info: dict[str, Any], status: dict[str, Any], settings: dict[str, Any], diagnostics: dict[str, Any]
) -> WebReport:
    """Understand the four pages' contents, as far as they go."""
    start, end = _number(settings, "fov", "start"), _number(settings, "fov", "end")
    wanted_rpm, rpm = _number(settings, "rpm"), _number(status, "motor", "rpm")
    ports = _number(settings, "host", "dport"), _number(settings, "host", "tport")
    boards = [_number(diagnostics, "volt_temp", board, "lm20_temp") for board in ("top", "bot")]
    laser = _switch(status, "laser", "state")
    return WebReport(
        _text(info, "model"),
        _text(info, "serial"),
        _firmware(info),
        _text(status, "gps", "pps_state").lower(),
        _switch(status, "motor", "state"),
        laser if laser is not None else _switch(settings, "laser"),
        None if rpm is None else rpm / 60,
        None if wanted_rpm is None else wanted_rpm / 60,
        _text(settings, "returns").lower(),
        None if start is None or end is None else (start, end),
        _text(settings, "host", "addr"),
        None if ports[0] is None else int(ports[0]),
        None if ports[1] is None else int(ports[1]),
        max((_celsius(counts) for counts in boards if counts is not None), default=None),
    )


def find_problems(report: WebReport, settings: LidarSettings) -> list[Finding]:
    """Find what on the web page keeps the profile's scans from coming."""
    problems = []
    product = velodyne.product_of(settings.model)
    reported = velodyne.product_of(report.model.replace(" ", "-")) or velodyne.product_of(report.model)
    if report.model and reported != product:
        models = {"model": report.model, "expected": settings.model}
        problems.append(Finding("settings.other_model", "warning", figures=models))
    if report.is_motor_on is False:
        problems.append(Finding("settings.motor_off", "warning"))
    if report.is_laser_on is False:
        problems.append(Finding("settings.laser_off", "warning"))
    wanted_hz = report.wanted_rotor_hz
    if wanted_hz is not None and not _is_near(wanted_hz, settings.rate_hz):
        figures = {
            "set_hz": wanted_hz,
            "expected_hz": settings.rate_hz,
            "expected_rpm": 60 * settings.rate_hz,
        }
        problems.append(Finding("settings.rotor_rate", "warning", figures=figures))
    if report.fov_deg is not None and (report.fov_deg[1] - report.fov_deg[0]) % 360 < 359:
        start_deg, end_deg = report.fov_deg
        problems.append(
            Finding("settings.fov_cut", "warning", figures={"start_deg": start_deg, "end_deg": end_deg})
        )
    port = settings.driver.port or velodyne.DATA_PORT
    if report.data_port is not None and report.data_port != port:
        ports = {"port": report.data_port, "expected_port": port}
        problems.append(Finding("settings.data_port", "warning", figures=ports))
    position_port = int(settings.driver.controls.get("position_port", velodyne.POSITION_PORT))
    if report.position_port is not None and report.position_port != position_port:
        ports = {"port": report.position_port, "expected_port": position_port}
        problems.append(Finding("settings.position_port", "warning", figures=ports))
    if settings.timestamps.clock == "utc" and report.pps and report.pps != "locked":
        problems.append(Finding("settings.pps", "warning", figures={"pps": report.pps}))
    return problems


def _find(content: Any, *keys: str) -> Any:
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    return content


def _text(content: dict[str, Any], *keys: str) -> str:
    found = _find(content, *keys)
    return str(found).strip() if isinstance(found, str | int | float) else ""


def _number(content: dict[str, Any], *keys: str) -> float | None:
    try:
        number = float(_text(content, *keys))
    except ValueError:
        return None
    return number if math.isfinite(number) and abs(number) < 1e9 else None


def _switch(content: dict[str, Any], *keys: str) -> bool | None:
    return {"on": True, "true": True, "1": True, "off": False, "false": False, "0": False}.get(
        _text(content, *keys).lower()
    )


def _firmware(info: dict[str, Any]) -> str:
    """Find the version of the application, wherever this firmware keeps it."""
    found = _find(info, "version")
    for key in ("application", "firmware", "version", "id"):
        if isinstance(found, dict):
            found = found.get(key, found)
    return str(found) if isinstance(found, str | int | float) else ""


def _celsius(counts: float) -> float:
    """Convert a reading of the LM20 on a board; VLP-16 User Manual, appendix on diagnostics."""
    return -1481.96 + math.sqrt(2.1962e6 + max(-5e5, (1.8639 - 5 * counts / 4096) / 3.88e-6))


def _is_near(value: float | None, wanted: float) -> bool:
    return value is not None and abs(value - wanted) <= 0.02 * wanted
