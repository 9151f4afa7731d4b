"""Removal of the folder of a session that has no capture."""

from contextlib import suppress
from pathlib import Path

from lce_rig.session.identity import MARKER
from lce_rig.session.session import CAPTURES, JOURNAL, LOCK, PROFILE

_MADE = frozenset({MARKER, PROFILE, JOURNAL, LOCK, CAPTURES})


def discard_if_empty(path: Path) -> bool:
    """Remove a session's folder if it holds nothing but the files of its creation.

    Args:
        path: the folder, without a writer.

    Returns:
        Whether it was removed. A folder with a capture or any other file is left unchanged.
    """
    with suppress(OSError):
        if {entry.name for entry in path.iterdir()} - _MADE:
            return False
        if (path / CAPTURES).is_dir():
            (path / CAPTURES).rmdir()  # fails where there is a capture
        # The marker last, so that an interrupted removal leaves a session.
        for name in (LOCK, JOURNAL, PROFILE, MARKER):
            (path / name).unlink(missing_ok=True)
        path.rmdir()
        return True
    return False
