"""Write GIF and video files."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from lce_rig.core.errors import SourceError
from lce_rig.show.overlays.canvas import Picture

# Codecs of OpenCV's own builds, by the file's suffix.
_CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "mp4v"}


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

    def frames() -> Iterator[PillowImage.Image]:
        for picture in pictures:
            yield PillowImage.fromarray(picture if picture.ndim == 2 else picture[..., ::-1])

    rest = frames()
    first = next(rest)
    duration_ms = max(20, 10 * round(100 * period_s))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        first.save(path, "GIF", save_all=True, append_images=rest, duration=duration_ms, loop=0)
    except OSError as error:
        raise _not_written(path, error) from error


def write_video(path: Path, pictures: Iterable[Picture], period_s: float) -> None:
    """Write a video with OpenCV.

    Args:
        path: the file; its suffix, .mp4, .avi or .mkv, gives the format.
        pictures: grey (H, W) or BGR (H, W, 3), all of one size; taken one at a time.
        period_s: time between images.

    Raises:
        SourceError: another suffix, a codec that this OpenCV lacks, or a file that cannot be written.
    """
    codec = _CODECS.get(path.suffix.lower())
    if codec is None:
        raise SourceError(
            f"{path}: unknown video format", f"Choose one of: {', '.join(_CODECS)}, or write a GIF."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise _not_written(path, error) from error
    writer = None
    for picture in pictures:
        bgr = np.ascontiguousarray(
            cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture
        )
        if writer is None:
            size = (bgr.shape[1], bgr.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 1 / period_s, size)
            if not writer.isOpened():
                break
        writer.write(bgr)
    if writer is not None:
        writer.release()
    if path.stat().st_size == 0:
        path.unlink()
        raise SourceError(
            f"{path}: this OpenCV cannot write videos (codec {codec})", "Write a GIF, or try another suffix."
        )


def _not_written(path: Path, error: OSError) -> SourceError:
    return SourceError(f"{path}: cannot be written: {error.strerror or error}", "Choose another folder.")
