"""The report of a result as a page: what its session adds to the calibrations."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from lce_rig.core.results import Calibration
from lce_rig.detect.detection import Pair
from lce_rig.session import Session

REPORT = "report.html"


def report_text(
    session: Session,
    calibrations: Sequence[Calibration],
    sessions: Mapping[str, Session],
    document: Mapping[str, Any],
    text: str,
    overlays: str,
) -> str:
    """Write the report of a result; the same result gives the same bytes.

    Args:
        session: whose result it is.
        calibrations: the result.
        sessions: of an estimate from several, by name, `session` first.
        document: content of result.json; text: the same as it is written.
        overlays: the folder of overlays beside the report.
    """
    from lce_rig.show.report.calibration_page import calibration_page

    pairs = [(c, channel) for c in calibrations for channel in c.channels]

    def paths(c: Calibration, capture: str) -> list[str]:
        """Name a capture's overlays as `verify` of the session does."""
        own = capture.rpartition("/")[2]
        if sessions and capture != f"{next(iter(sessions))}/{own}":
            return []
        held = session.capture(own)
        found = []
        for channel in c.channels:
            if held.has_image(c.camera, channel) or (channel == "events" and c.camera in held.event_cameras):
                folder = f"{Pair(c.camera, channel, c.lidar).folder_name}/" if len(pairs) > 1 else ""
                found.append(f"{overlays}/{folder}{own}.png")
        return found

    return calibration_page(
        session.rig, calibrations, facts=_facts(calibrations, document, text), overlays=paths
    )


def _facts(
    calibrations: Sequence[Calibration], document: Mapping[str, Any], text: str
) -> list[tuple[str, str]]:
    """List what identifies a result."""
    provenance = document.get("provenance") or {}
    facts = [
        ("rig", document["rig"]),
        ("robot", provenance.get("robot") or ""),
        ("date of the captures", provenance.get("date") or ""),
        *((f"serial number of {name}", serial) for name, serial in (provenance.get("serials") or {}).items()),
        ("sessions", ", ".join(document.get("sessions") or ())),
        ("method", ", ".join(dict.fromkeys(c.method for c in calibrations))),
        ("made by", document["made_by"]),
        ("SHA-256 of the session", provenance.get("session_sha256") or ""),
        ("SHA-256 of result.json", hashlib.sha256(text.encode()).hexdigest()),
    ]
    return [(name, value) for name, value in facts if value]
