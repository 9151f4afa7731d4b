"""Many pictures on one sheet."""

from collections.abc import Sequence

import numpy as np

from lce_rig.verify import canvas
from lce_rig.verify.canvas import INK, Picture

_GAP_PX = 10
_CAPTION_PX = 30


def contact_sheet(
    tiles: Sequence[tuple[str, Picture]], *, columns: int | None = None, tile_width_px: int = 480
) -> Picture:
    """Lay named pictures out in rows, each scaled to the same width with its name below.

    Args:
        tiles: names and BGR pictures, in order.
        columns: pictures in a row; by default about as many as rows, at most 6.
        tile_width_px: width of one picture.

    Raises:
        ValueError: there are no tiles.
    """
    if not tiles:
        raise ValueError("a contact sheet needs at least one picture")
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
