"""Where simulated boards are kept: a folder for each state of simulator, detectors and profile."""

import hashlib
from pathlib import Path

import lce_rig
from lce_rig import pipeline
from lce_rig.rig import Rig


def kept_folder(folder: Path, rig: Rig, what: object = "", packages: tuple[str, ...] = ("simulate",)) -> Path:
    """Name a folder after everything that what was detected depends on: other code has another folder.

    Args:
        folder: that it lies in.
        rig: the profile.
        what: whatever else decides, such as the options of the simulation; its repr counts.
        packages: of lce_rig that make the sessions.
    """
    digest = hashlib.sha256(f"{pipeline.detection_digest(rig)} {what!r}".encode())
    for package in packages:
        for source in sorted((Path(lce_rig.__file__).parent / package).rglob("*.py")):
            digest.update(source.read_bytes())
    return folder / f"{rig.name}-{digest.hexdigest()[:12]}"
