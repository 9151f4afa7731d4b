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
from lce_rig.core.findings import Figure, Finding
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
        rpm: speed of the rotor that is set.
        returns: "strongest", "last" or "dual".
        fov_deg: first and last azimuth that is sent.
        host: address that packets are sent to; 255.255.255.255 is everybody.
        data_port, position_port: UDP ports they are sent to.
    """

    model: str = ""
    serial: str = ""
    firmware: str = ""
    pps: str = ""
    is_motor_on: bool | None = None
    is_laser_on: bool | None = None
    rpm: float | None = None
    returns: str = ""
    fov_deg: tuple[float, float] | None = None
    host: str = ""
    data_port: int | None = None
    position_port: int | None = None


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
        """Read info, status and settings; nothing is changed.

        Raises:
            SourceError: nothing answers, or what answers is no Velodyne.
        """
        info, status, settings = self._get("info"), self._get("status"), self._get("settings")
        start, end = _number(settings, "fov", "start"), _number(settings, "fov", "end")
        data_port = _number(settings, "host", "dport")
        position_port = _number(settings, "host", "tport")
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
            rpm=_number(settings, "rpm"),
            returns=_text(settings, "returns").lower(),
            fov_deg=None if start is None or end is None else (start, end),
            host=_text(settings, "host", "addr"),
            data_port=None if data_port is None else int(data_port),
            position_port=None if position_port is None else int(position_port),
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
    """Find what on the web page keeps the profile's scans from coming; what it lacks is left out."""
    problems: list[Finding] = []

    def compare(setting: str, value: Figure, expected: Figure, is_wrong: object) -> None:
        if is_wrong:
            problems.append(findings.SETTING_DIFFERS(setting=setting, value=value, expected=expected))

    model = velodyne.product_of(report.model.replace(" ", "-")) or velodyne.product_of(report.model)
    is_other = report.model and model != velodyne.product_of(settings.model)
    compare("model", report.model, settings.model, is_other)
    compare("motor", "off", "on", report.is_motor_on is False)
    compare("laser", "off", "on", report.is_laser_on is False)
    if report.rpm is not None:
        wanted_rpm = 60 * settings.rate_hz
        is_off = abs(report.rpm - wanted_rpm) > _MAX_OFF_RATE * wanted_rpm
        compare("rpm", report.rpm, wanted_rpm, is_off)
    if report.fov_deg is not None:
        first_deg, last_deg = report.fov_deg
        compare("field of view", report.fov_deg, (0, 359), (last_deg - first_deg) % 360 < 359)
    port = settings.driver.port or velodyne.DATA_PORT
    compare("data port", report.data_port, port, report.data_port not in (None, port))
    port = int(settings.driver.controls.get("position_port", velodyne.POSITION_PORT))
    compare("telemetry port", report.position_port, port, report.position_port not in (None, port))
    is_utc = settings.timestamps.clock == "utc"
    compare("PPS", report.pps, "locked", is_utc and report.pps not in ("", "locked"))
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
