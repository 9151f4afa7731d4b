"""Removal of the folder of a session that has no capture."""

from contextlib import suppress
from pathlib import Path

from lce_rig.session.identity import MARKER
from lce_rig.session.session import CAPTURES, JOURNAL, LOCK, PROFILE

_MADE = frozenset({MARKER, PROFILE, JOURNAL, LOCK, CAPTURES})


def discard_if_empty(path: Path) -> bool:
    """Remove a session's folder where it holds nothing but what making it wrote.

    Args:
        path: the folder; nobody writes to it.

    Returns:
        Whether it is gone. A folder with a capture, or with anything else in it, is left as it is.
    """
    with suppress(OSError):
        if {entry.name for entry in path.iterdir()} - _MADE:
            return False
        if (path / CAPTURES).is_dir():
            (path / CAPTURES).rmdir()  # fails where there is a capture
        # The marker last: what is left of an interrupted removal is still a session.
        for name in (LOCK, JOURNAL, PROFILE, MARKER):
            (path / name).unlink(missing_ok=True)
        path.rmdir()
        return True
    return False
