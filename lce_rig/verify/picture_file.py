"""Pictures to files."""

from pathlib import Path

from lce_rig.core.errors import SessionError
from lce_rig.verify.canvas import Picture


def write_picture(path: Path, picture: Picture) -> None:
    """Write a BGR picture; the suffix names the format.

    Raises:
        SessionError: it cannot be written.
    """
    import cv2

    is_encoded, data = cv2.imencode(path.suffix, picture)
    if not is_encoded:
        raise SessionError(f"{path}: the picture cannot be encoded")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise SessionError(f"{path}: cannot be written: {error.strerror}") from error
