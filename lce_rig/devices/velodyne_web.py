"""The web page of a Velodyne: identity, state and settings.

Firmware differs in what it tells and in the types of its values: every field may be missing, numbers come as
text, switches as "On", "on" or true.

References:
    VLP-16 User Manual, Velodyne 63-9243 Rev. D, chapter 8 and appendix on curl commands.
"""

import json
import math
from http.client import HTTPException
from typing import Any, NamedTuple
from urllib.error import HTTPError, URLError
from urllib.request import ProxyHandler, build_opener

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.rig import LidarSettings

_TIMEOUT_S = 2.0
_MAX_BODY_BYTES = 1 << 20
_MAX_OFF_RATE = 0.02
_SWITCH = {"on": True, "true": True, "1": True, "off": False, "false": False, "0": False}
# Bypass proxies: the sensor is on the local network.
_OPENER = build_opener(ProxyHandler({}))


class WebReport(NamedTuple):
    """The contents of the web page; fields are "" or None where it lacks them.

    Attributes:
        model, serial, firmware: of the sensor.
        pps: "absent", "synchronizing", "locked" or "error".
        is_motor_on, is_laser_on: whether they run.
        rotor_hz, wanted_rotor_hz: measured speed, and the speed that is set.
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
        info, status, settings = self._get("info"), self._get("status"), self._get("settings")
        try:
            diagnostics = self._get("diag")
        except SourceError:  # Not every firmware has them.
            diagnostics = {}
        start, end = _number(settings, "fov", "start"), _number(settings, "fov", "end")
        rpm, wanted_rpm = _number(status, "motor", "rpm"), _number(settings, "rpm")
        data_port = _number(settings, "host", "dport")
        position_port = _number(settings, "host", "tport")
        boards = [_number(diagnostics, "volt_temp", board, "lm20_temp") for board in ("top", "bot")]
        # The version of the application, wherever this firmware keeps it.
        version = info.get("version")
        for key in ("application", "firmware", "version", "id"):
            version = version.get(key, version) if isinstance(version, dict) else version
        laser = _SWITCH.get(_text(status, "laser", "state").lower())
        return WebReport(
            model=_text(info, "model"),
            serial=_text(info, "serial"),
            firmware=str(version) if isinstance(version, str | int | float) else "",
            pps=_text(status, "gps", "pps_state").lower(),
            is_motor_on=_SWITCH.get(_text(status, "motor", "state").lower()),
            is_laser_on=laser if laser is not None else _SWITCH.get(_text(settings, "laser").lower()),
            rotor_hz=None if rpm is None else rpm / 60,
            wanted_rotor_hz=None if wanted_rpm is None else wanted_rpm / 60,
            returns=_text(settings, "returns").lower(),
            fov_deg=None if start is None or end is None else (start, end),
            host=_text(settings, "host", "addr"),
            data_port=None if data_port is None else int(data_port),
            position_port=None if position_port is None else int(position_port),
            temperature_c=max((_celsius(counts) for counts in boards if counts is not None), default=None),
        )

    def read_serial(self) -> str:
        """Read the serial number alone; "" where the page lacks it.

        Raises:
            SourceError: nothing answers, or what answers is no Velodyne.
        """
        return _text(self._get("info"), "serial")

    def _get(self, page: str) -> dict[str, Any]:
        url = f"{self.url}/cgi/{page}.json"
        try:
            with _OPENER.open(url, timeout=self._timeout_s) as response:
                body = bytes(response.read(_MAX_BODY_BYTES))
        except (URLError, HTTPException, OSError, ValueError) as error:
            if isinstance(error, HTTPError):
                error.close()  # it is an open answer, too
            raise SourceError(
                f"{url} does not answer: {getattr(error, 'reason', None) or error}",
                "Check cable and power, and that this computer has an address in the LiDAR's network "
                "(192.168.1.x, mask 255.255.255.0).",
            ) from None
        try:
            content = json.loads(body)
        except (ValueError, RecursionError):  # Also where it is no UTF-8.
            content = None
        if not isinstance(content, dict):
            hint = "Is driver.address the LiDAR's? Another device may have that address."
            raise SourceError(f"{url} is not what a Velodyne answers", hint)
        return content


def find_problems(report: WebReport, settings: LidarSettings) -> list[Finding]:
    """Find what on the web page keeps the profile's scans from coming."""
    problems = []
    product = velodyne.product_of(settings.model)
    reported = velodyne.product_of(report.model.replace(" ", "-")) or velodyne.product_of(report.model)
    if report.model and reported != product:
        problems.append(findings.OTHER_MODEL(model=report.model, expected=settings.model))
    if report.is_motor_on is False:
        problems.append(findings.MOTOR_OFF())
    if report.is_laser_on is False:
        problems.append(findings.LASER_OFF())
    set_hz, rate_hz = report.wanted_rotor_hz, settings.rate_hz
    if set_hz is not None and abs(set_hz - rate_hz) > _MAX_OFF_RATE * rate_hz:
        rotor = findings.ROTOR_SETTING(set_hz=set_hz, expected_hz=rate_hz, expected_rpm=60 * rate_hz)
        problems.append(rotor)
    if report.fov_deg is not None and (report.fov_deg[1] - report.fov_deg[0]) % 360 < 359:
        problems.append(findings.FOV_CUT(start_deg=report.fov_deg[0], end_deg=report.fov_deg[1]))
    port = settings.driver.port or velodyne.DATA_PORT
    if report.data_port is not None and report.data_port != port:
        problems.append(findings.DATA_PORT(port=report.data_port, expected_port=port))
    position_port = int(settings.driver.controls.get("position_port", velodyne.POSITION_PORT))
    if report.position_port is not None and report.position_port != position_port:
        problems.append(findings.POSITION_PORT(port=report.position_port, expected_port=position_port))
    if settings.timestamps.clock == "utc" and report.pps and report.pps != "locked":
        problems.append(findings.PPS_SETTING(pps=report.pps))
    return problems


def _text(content: Any, *keys: str) -> str:
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    return str(content).strip() if isinstance(content, str | int | float) else ""


def _number(content: dict[str, Any], *keys: str) -> float | None:
    try:
        number = float(_text(content, *keys))
    except ValueError:
        return None
    return number if math.isfinite(number) and abs(number) < 1e9 else None


def _celsius(counts: float) -> float:
    """Convert a reading of the LM20 on a board; VLP-16 User Manual, appendix on diagnostics."""
    return -1481.96 + math.sqrt(2.1962e6 + max(-5e5, (1.8639 - 5 * counts / 4096) / 3.88e-6))
