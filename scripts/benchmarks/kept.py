"""Where simulated boards are kept: a folder for each state of simulator, detectors and profile."""

import hashlib
from pathlib import Path

import lce_rig
from lce_rig.pipeline.detect_session import detection_digest
from lce_rig.rig import Rig


def kept_folder(
    folder: Path,
    rig: Rig,
    what: object = "",
    packages: tuple[str, ...] = ("simulate",),
    *,
    is_detected: bool = True,
) -> Path:
    """Name a folder after everything that its content depends on: other code has another folder.

    Args:
        folder: that it lies in.
        rig: the profile.
        what: whatever else decides, such as the options of the simulation; its repr counts.
        packages: of lce_rig that make the sessions.
        is_detected: whether the content depends on the detectors.
    """
    source = detection_digest(rig) if is_detected else rig.model_dump_json()
    digest = hashlib.sha256(f"{source} {what!r}".encode())
    for package in packages:
        for file in sorted((Path(lce_rig.__file__).parent / package).rglob("*.py")):
            digest.update(file.read_bytes())
    return folder / f"{rig.name}-{digest.hexdigest()[:12]}"
