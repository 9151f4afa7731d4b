"""The files of a result in its session: written, fingerprinted, removed before the next."""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from lce_rig.core.results import Calibration
from lce_rig.session import Session
from lce_rig.session.session import CAPTURES, PROFILE
from lce_rig.session.writing import MANIFEST

CALIBRATION, OVERLAYS = "calibration", "overlays"


def write_results(session: Session, calibrations: Sequence[Calibration], *, force: bool) -> list[Path]:
    """Write result.json and, unless a verdict forbids it, every export beside it.

    Returns:
        The files written, result.json first.
    """
    from lce_rig.export import remove_exports, write_exports
    from lce_rig.export.result import write_result

    folder = session.path / CALIBRATION
    folder.mkdir(exist_ok=True)
    result = folder / "result.json"
    write_result(result, session.rig.name, calibrations, inputs_sha256(session, calibrations))
    usable = [c for c in calibrations if force or c.verdict != "fail"]
    if not usable:
        remove_exports(folder)
        return [result]
    return [result, *write_exports(usable, session.rig, folder, is_forced=force)]


def inputs_sha256(session: Session, calibrations: Sequence[Calibration]) -> dict[str, str]:
    """Fingerprint what results were made from: the profile, and the manifest of every capture used.

    A manifest vouches for the capture's files, whose SHA-256 it holds.

    Returns:
        SHA-256 by path in the session.

    Raises:
        SessionError: a capture that was used is no longer there.
    """
    used = sorted({name for calibration in calibrations for name in calibration.captures_used})
    profile = hashlib.sha256((session.path / PROFILE).read_bytes()).hexdigest()
    manifests = {f"{CAPTURES}/{name}/{MANIFEST}": session.capture(name).manifest_sha256 for name in used}
    return {PROFILE: profile, **manifests}


def remove_results(session: Session) -> None:
    """Remove the result, exports and pictures of an earlier run: they must not pass for this one's."""
    from lce_rig.export import remove_exports

    folder = session.path / CALIBRATION
    if folder.is_dir():
        remove_exports(folder)
        (folder / "result.json").unlink(missing_ok=True)
        shutil.rmtree(folder / OVERLAYS, ignore_errors=True)
