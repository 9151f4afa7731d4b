"""The web page of a Velodyne: identity, state and settings.

Firmware differs in what it tells and in the types of its values: every field may be missing, numbers come as
text, switches as "On", "on" or true.

References:
    VLP-16 User Manual, Velodyne 63-9243 Rev. D, chapter 8 and appendix on curl commands.
"""

import json
import math
from collections.abc import Mapping
from http.client import HTTPException
from typing import Any, TypeAlias
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


WebReport: TypeAlias = Mapping[str, Any]
"""The contents of the web page; what it lacks is missing.

Text: `model`, `serial`, `firmware`; `pps`, "absent", "synchronizing", "locked" or "error"; `returns`,
"strongest", "last" or "dual"; `host`, the address that packets are sent to. Switches: `is_motor_on`,
`is_laser_on`. Numbers: `rpm`, `fov_deg` (first and last azimuth that is sent), `data_port`, `position_port`.
"""


def read_web(address: str, port: int = 80, timeout_s: float = _TIMEOUT_S) -> WebReport:
    """Read info, status and settings of a sensor; nothing is changed.

    Raises:
        SourceError: nothing answers, or what answers is no Velodyne.
    """
    info, status, settings = (
        read_page(address, port, timeout_s, page) for page in ("info", "status", "settings")
    )
    start, end = _number(settings, "fov", "start"), _number(settings, "fov", "end")
    data_port, position_port = (_number(settings, "host", name) for name in ("dport", "tport"))
    # The version of the application, wherever this firmware keeps it.
    version = info.get("version")
    for key in ("application", "firmware", "version", "id"):
        version = version.get(key, version) if isinstance(version, dict) else version
    laser = _SWITCH.get(_text(status, "laser", "state").lower())
    report = {
        "model": _text(info, "model"),
        "serial": _text(info, "serial"),
        "firmware": str(version) if isinstance(version, str | int | float) else "",
        "pps": _text(status, "gps", "pps_state").lower(),
        "is_motor_on": _SWITCH.get(_text(status, "motor", "state").lower()),
        "is_laser_on": laser if laser is not None else _SWITCH.get(_text(settings, "laser").lower()),
        "rpm": _number(settings, "rpm"),
        "returns": _text(settings, "returns").lower(),
        "fov_deg": None if start is None or end is None else (start, end),
        "host": _text(settings, "host", "addr"),
        "data_port": None if data_port is None else int(data_port),
        "position_port": None if position_port is None else int(position_port),
    }
    return {name: value for name, value in report.items() if value not in ("", None)}


def read_page(address: str, port: int, timeout_s: float, page: str) -> dict[str, Any]:
    """Read one page, such as "info".

    Raises:
        SourceError: nothing answers, or what answers is no Velodyne.
    """
    url = f"http://{address}{f':{port}' if port != 80 else ''}/cgi/{page}.json"
    try:
        with _OPENER.open(url, timeout=timeout_s) as response:
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

    model = report.get("model", "")
    product = velodyne.product_of(model.replace(" ", "-")) or velodyne.product_of(model)
    compare("model", model, settings.model, model and product != velodyne.product_of(settings.model))
    compare("motor", "off", "on", report.get("is_motor_on") is False)
    compare("laser", "off", "on", report.get("is_laser_on") is False)
    wanted_rpm = 60 * settings.rate_hz
    rpm, (first_deg, last_deg) = report.get("rpm", wanted_rpm), report.get("fov_deg", (0, 359))
    compare("rpm", rpm, wanted_rpm, abs(rpm - wanted_rpm) > _MAX_OFF_RATE * wanted_rpm)
    compare("field of view", (first_deg, last_deg), (0, 359), (last_deg - first_deg) % 360 < 359)
    port = settings.driver.port or velodyne.DATA_PORT
    compare("data port", report.get("data_port"), port, report.get("data_port") not in (None, port))
    port = int(settings.driver.controls.get("position_port", velodyne.POSITION_PORT))
    compare(
        "telemetry port", report.get("position_port"), port, report.get("position_port") not in (None, port)
    )
    is_utc = settings.timestamps.clock == "utc"
    compare("PPS", report.get("pps"), "locked", is_utc and report.get("pps", "locked") != "locked")
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
