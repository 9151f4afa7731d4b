"""Origin of a result: robot, sensors, date, and a fingerprint of its inputs."""

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime, timezone
from typing import Any

from lce_rig.core.calibration import Provenance
from lce_rig.core.errors import SessionError
from lce_rig.rig import Rig
from lce_rig.session.capture import Capture
from lce_rig.session.session import CAPTURED, Session

# Timestamps before 2000 do not count from 1970, but usually from the sensor's start.
_FIRST_UTC_NS = 946_684_800 * 10**9
_LAST_UTC_NS = 4_102_444_800 * 10**9


def provenance_of(session: Session) -> Provenance:
    """Collect the origin of a result.

    Raises:
        SessionError: two units of one sensor took the captures.
    """
    date, imported = date_of(session), []
    # Time at which a capture was added to the session, from its journal.
    for entry in [] if date else session.read_journal():
        if entry.get("event") == CAPTURED:
            with suppress(TypeError, ValueError, OverflowError):
                time = datetime.fromisoformat(str(entry.get("time")))
                imported.append(time.astimezone(timezone.utc))
    return Provenance(
        robot=session.rig.robot or "",
        serials=serials_of(session),
        date=date,
        session_sha256=content_sha256(session),
        imported=_in_utc(max(imported)) if imported else None,
    )


def serials_of(session: Session) -> dict[str, str]:
    """Return the serial number of each sensor, as reported or stated in the profile.

    Raises:
        SessionError: two units of one sensor took the captures.
    """
    sources: dict[str, tuple[str, str]] = {}
    devices = [(c.name, c.serials) for c in _readable(session.captures)]
    for where, serials in (("the profile", stated_serials(session.rig)), *devices):
        for sensor, serial in serials.items():
            first, other = sources.setdefault(sensor, (where, serial))
            if other != serial:
                raise SessionError(
                    f"{session.path}: {sensor} has serial number {other} in {first}, {serial} in {where}",
                    "One result requires one set of sensors: reject the captures of the other unit with "
                    f"`lce-rig captures {session.path}`, or correct `serial` in rig.yaml.",
                )
    return {sensor: serial for sensor, (_, serial) in sorted(sources.items())}


def stated_serials(rig: Rig) -> dict[str, str]:
    """List the serial numbers in a profile, by sensor."""
    lidars = {name: lidar.serial for name, lidar in rig.lidars.items() if lidar.serial}
    return lidars | {name: camera.serial for name, camera in rig.cameras.items() if camera.serial}


def date_of(session: Session) -> str | None:
    """Return the time of a session's last capture: of arrival, else by its timestamps if these are UTC.

    None if the recording carries no time: the import into the session may be much later.
    """
    times_ns = [time_ns for capture in _readable(session.captures) for time_ns in capture.times_ns]
    in_utc = [time_ns for time_ns in times_ns if _FIRST_UTC_NS <= time_ns < _LAST_UTC_NS]
    return _in_utc(datetime.fromtimestamp(max(in_utc) // 10**9, timezone.utc)) if in_utc else None


def _in_utc(time: datetime) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ")


def content_sha256(session: Session) -> str:
    """Return the SHA-256 of a result's inputs: the profile, all samples and timestamps of all captures.

    It does not depend on the session's folder, the names of recordings, the robot's name, or the connection
    of sensors. The order of captures counts, as random subsets depend on it. A capture contributes the
    SHA-256 of its files from its manifest, which reading a capture checks.
    """
    digest = hashlib.sha256(_canonical(_profile(session.rig)))
    for capture in session.captures:
        try:
            digest.update(_canonical(capture.contents))
        except SessionError:  # Detection refuses it.
            digest.update(b"damaged\n")
    return digest.hexdigest()


def _profile(rig: Rig) -> dict[str, Any]:
    """Return the parts of a profile that affect a result."""
    profile = rig.model_dump(mode="json", exclude_defaults=True, exclude={"description", "robot", "exports"})
    for kind in ("lidars", "cameras"):
        for sensor in profile.get(kind, {}).values():
            sensor.pop("driver", None)
            sensor.pop("serial", None)
    for key in ("device", "baud"):
        profile.get("sync", {}).pop(key, None)
    return profile


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _readable(captures: Iterable[Capture]) -> Iterable[Capture]:
    for capture in captures:
        with suppress(SessionError):  # A damaged capture is reported when it is read.
            _ = capture.contents
            yield capture
