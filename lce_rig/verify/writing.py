"""Pictures into a folder."""

import re
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from lce_rig.core.errors import SessionError
from lce_rig.session.durable import replace_file
from lce_rig.verify import canvas
from lce_rig.verify.canvas import Picture
from lce_rig.verify.contact_sheet import contact_sheet

CONTACT_SHEET = "contact_sheet.png"
_TILE_PX = 480
# Overlays have large even areas and thin marks: runs pack them as tightly as a search does, in half the time.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]


def write_overlays(folder: Path, overlays: Iterable[tuple[str, Picture, Picture]]) -> list[Path]:
    """Write one PNG per named picture and a contact sheet of them all.

    Pictures are taken one at a time and only small copies are kept: a long session needs little memory.

    Args:
        folder: is made where it does not exist.
        overlays: name (of the capture), BGR picture, and the part of it that goes onto the contact sheet.

    Returns:
        The files, the contact sheet last; none where there are no pictures.

    Raises:
        SessionError: a file cannot be written.
    """
    files: list[Path] = []
    tiles: list[tuple[str, Picture]] = []
    for name, picture, part in overlays:
        files.append(write_picture(folder / f"{_file_name(name)}.png", picture))
        height_px = round(part.shape[0] * _TILE_PX / part.shape[1])
        tiles.append((name, canvas.fitted(part, _TILE_PX, height_px)))
    if tiles:
        files.append(write_picture(folder / CONTACT_SHEET, contact_sheet(tiles, tile_width_px=_TILE_PX)))
    return files


def is_overlay(path: Path) -> bool:
    """Tell by its name whether a file is one that `write_overlays` makes of a session's captures."""
    return path.name == CONTACT_SHEET or re.fullmatch(r"[0-9]{6,}\.png", path.name) is not None


def write_picture(path: Path, picture: Picture) -> Path:
    """Write one PNG, whole or not at all.

    Raises:
        SessionError: the file cannot be written.
    """
    is_encoded, data = cv2.imencode(".png", picture, _PNG)
    if not is_encoded:
        raise SessionError(f"{path}: a picture of shape {picture.shape} cannot be written as PNG")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, np.asarray(data).tobytes())
    except OSError as error:
        hint = "free space on the disk or choose another folder"
        raise SessionError(f"{path}: cannot be written: {error.strerror}", hint) from error
    return path


def _file_name(name: str) -> str:
    """Keep letters, digits, dot, dash and underscore of a name, so that it stays in its folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".") or "picture"
