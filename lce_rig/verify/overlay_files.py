"""Write images into a folder."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from lce_rig.core.errors import SessionError
from lce_rig.session.durable import write_atomically
from lce_rig.verify import canvas
from lce_rig.verify.canvas import INK, Picture

# Many images on one sheet.

_GAP_PX = 10
_CAPTION_PX = 30


def contact_sheet(
    tiles: Sequence[tuple[str, Picture]], *, columns: int | None = None, tile_width_px: int = 480
) -> Picture:
    """Arrange named images in rows, each scaled to the same width with its name below.

    Args:
        tiles: names and BGR images, in order.
        columns: images per row; by default about the number of rows, at most 6.
        tile_width_px: width of one image.

    Raises:
        ValueError: there are no tiles.
    """
    if not tiles:
        raise ValueError("a contact sheet needs at least one image")
    n_columns = min(columns or min(6, int(np.ceil(np.sqrt(len(tiles))))), len(tiles))
    height_px = max(round(tile_width_px * picture.shape[0] / picture.shape[1]) for _, picture in tiles)
    n_rows = -(-len(tiles) // n_columns)
    cell_u, cell_v = tile_width_px + _GAP_PX, height_px + _CAPTION_PX + _GAP_PX
    sheet = canvas.panel(n_columns * cell_u + _GAP_PX, n_rows * cell_v + _GAP_PX)
    for index, (name, picture) in enumerate(tiles):
        u = _GAP_PX + (index % n_columns) * cell_u
        v = _GAP_PX + (index // n_columns) * cell_v
        sheet[v : v + height_px, u : u + tile_width_px] = canvas.fitted(picture, tile_width_px, height_px)
        canvas.draw_text(sheet, name, u + 4, v + height_px + 0.68 * _CAPTION_PX, 11, INK)
    return sheet


CONTACT_SHEET = "contact_sheet.png"
_TILE_PX = 480
# Overlays have large even areas and thin marks: run lengths compress them as well as a search, in half the
# time.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]


def write_overlays(folder: Path, overlays: Iterable[tuple[str, Picture, Picture]]) -> list[Path]:
    """Write one PNG per named image and a contact sheet of them all.

    Images are taken one at a time and only small copies are kept, so that a long session needs little memory.

    Args:
        folder: created if it does not exist.
        overlays: name (of the capture), BGR image, and the part of it that goes onto the contact sheet.

    Returns:
        The files, the contact sheet last; none if there are no images.

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
    """Return whether a file has a name that `write_overlays` gives to a session's captures."""
    return path.name == CONTACT_SHEET or re.fullmatch(r"[0-9]{6,}\.png", path.name) is not None


def write_picture(path: Path, picture: Picture) -> Path:
    """Write one PNG in one step.

    Raises:
        SessionError: the file cannot be written.
    """
    is_encoded, data = cv2.imencode(".png", picture, _PNG)
    if not is_encoded:
        raise SessionError(f"{path}: an image of shape {picture.shape} cannot be written as PNG")
    write_atomically(path, np.asarray(data).tobytes())
    return path


def _file_name(name: str) -> str:
    """Keep letters, digits, dot, dash and underscore of a name, so that it stays in its folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".") or "picture"
