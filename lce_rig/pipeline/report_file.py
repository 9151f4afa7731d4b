"""The report of a result as a page: the facts and overlays that its session adds to the calibrations."""

import hashlib
from collections.abc import Mapping

from lce_rig.core.calibration import Calibration, ResultFile
from lce_rig.detect.detection import Pair
from lce_rig.session import Session
from lce_rig.show.report.calibration_page import calibration_page

REPORT = "report.html"


def report_text(
    session: Session, sessions: Mapping[str, Session], file: ResultFile, text: str, overlays: str
) -> str:
    """Write the report of a result; the same result gives the same bytes.

    Args:
        session: whose result it is.
        sessions: of an estimate from several, by name, `session` first.
        file: the result; text: the same as it is written.
        overlays: the folder of overlays beside the report.
    """
    n_pairs = sum(len(c.channels) for c in file.pairs)

    def paths(c: Calibration, capture: str) -> list[str]:
        """Name a capture's overlays as `verify` of the session does."""
        name = capture.rpartition("/")[2]
        if sessions and capture != f"{next(iter(sessions))}/{name}":
            return []
        held = session.capture(name)
        paths = []
        for channel in c.channels:
            if held.has_image(c.camera, channel) or (channel == "events" and c.camera in held.event_cameras):
                folder = f"{Pair(c.camera, channel, c.lidar).folder_name}/" if n_pairs > 1 else ""
                paths.append(f"{overlays}/{folder}{name}.png")
        return paths

    origin = file.provenance
    facts = [
        ("rig", file.rig),
        ("robot", origin.robot),
        ("date of the captures", origin.date),
        *((f"serial number of {name}", serial) for name, serial in sorted(origin.serials.items())),
        ("sessions", ", ".join(file.sessions)),
        ("method", ", ".join(dict.fromkeys(c.method for c in file.pairs))),
        ("made by", file.made_by),
        ("SHA-256 of the session", origin.session_sha256),
        ("SHA-256 of result.json", hashlib.sha256(text.encode()).hexdigest()),
    ]
    facts = [(name, value) for name, value in facts if value]
    return calibration_page(session.rig, file.pairs, facts=facts, overlays=paths)
