"""Write GIF and video files."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from lce_rig.core.errors import SourceError
from lce_rig.show.overlays.canvas import Picture

# Codecs of OpenCV's own builds, by the file's suffix.
_CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "mp4v"}


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise SourceError(
            f"{path}: cannot be written: {error.strerror or error}", "Choose another folder."
        ) from error


def write_gif(path: Path, pictures: Iterable[Picture], period_s: float) -> None:
    """Write an endless GIF.

    Args:
        path: the file.
        pictures: grey (H, W) or BGR (H, W, 3), all of one size, at least one; taken one at a time.
        period_s: time between images; GIFs count in steps of 10 ms, and viewers slow down below 20 ms.

    Raises:
        SourceError: pillow is not installed, or the file cannot be written.
    """
    try:
        from PIL import Image as PillowImage
    except ImportError as error:
        raise SourceError("GIFs require pillow, which is not installed", "Run: pip install pillow") from error

    frames = (PillowImage.fromarray(each if each.ndim == 2 else each[..., ::-1]) for each in pictures)
    duration_ms = max(20, 10 * round(100 * period_s))
    first = next(frames)
    with _writing(path):
        first.save(path, "GIF", save_all=True, append_images=frames, duration=duration_ms, loop=0)


def write_video(path: Path, pictures: Iterable[Picture], period_s: float) -> None:
    """Write a video with OpenCV.

    Args:
        path: the file; its suffix, .mp4, .avi or .mkv, gives the format.
        pictures: grey (H, W) or BGR (H, W, 3), all of one size, at least one; taken one at a time.
        period_s: time between images.

    Raises:
        SourceError: another suffix, a codec that this OpenCV lacks, or a file that cannot be written.
    """
    codec = _CODECS.get(path.suffix.lower())
    if codec is None:
        raise SourceError(
            f"{path}: unknown video format", f"Choose one of: {', '.join(_CODECS)}, or write a GIF."
        )
    with _writing(path):
        path.touch()
    writer = cv2.VideoWriter()
    for picture in pictures:
        bgr = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture
        if not writer.isOpened():
            size = (bgr.shape[1], bgr.shape[0])
            if not writer.open(str(path), cv2.VideoWriter.fourcc(*codec), 1 / period_s, size):
                break
        writer.write(np.ascontiguousarray(bgr))
    writer.release()
    if path.stat().st_size == 0:
        path.unlink()
        raise SourceError(
            f"{path}: this OpenCV cannot write videos (codec {codec})", "Write a GIF, or try another suffix."
        )
