"""The board of a profile with the dimensions to measure."""

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.transforms import Affine2D

from lce_rig.rig import Rig

INK, BLUE, RED = "#1c2733", "#2f5d8a", "#c2410c"


def draw_board(rig: Rig) -> Any:
    """Draw plate and pattern twice: upright with dimensions, and as a diamond before the LiDAR's rings."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12.6, 5.2), width_ratios=(1.65, 1))
    _draw_plate(left, rig)
    _draw_dimensions(left, rig)
    _draw_plate(right, rig, turned_deg=45)
    _draw_rings(right, rig)
    left.set_title("Measure: every figure goes into the profile", color=INK, fontsize=15)
    right.set_title("Hold it as a diamond: rings cross all four edges", color=INK, fontsize=15)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.axis("off")
    figure.tight_layout()
    return figure


def _draw_plate(axes: Any, rig: Rig, turned_deg: float = 0.0) -> None:
    board = rig.board.to_board()
    turn = Affine2D().rotate_deg(turned_deg) + axes.transData
    outline = Polygon(1000 * board.outline()[:, :2], fc="#f4f4f1", ec=INK, lw=1.5)
    side_mm = 1000 * board.square_m
    x0, y0 = 1000 * board.corners()[:, :2].min(axis=0) - side_mm
    squares = [
        Rectangle((x0 + col * side_mm, y0 + row * side_mm), side_mm, side_mm, fc="#222222", ec="none")
        for row in range(board.rows + 1)
        for col in range(board.cols + 1)
        if (row + col) % 2 == 0
    ]
    for patch in (outline, *squares):
        patch.set_transform(turn)
        axes.add_patch(patch)
    if not turned_deg:
        for x, y, _ in 1000 * board.corners():
            axes.add_patch(Circle((x, y), 5, fc="white", ec=RED, lw=1.2, zorder=3))


def _draw_dimensions(axes: Any, rig: Rig) -> None:
    board = rig.board.to_board()
    w, h, side_mm = 1000 * board.width_m / 2, 1000 * board.height_m / 2, 1000 * board.square_m
    corners = 1000 * board.corners()[:, :2]
    (x_low, y_low), y_high = corners.min(axis=0), corners[:, 1].max()
    _dimension(axes, (-w, -h - 55), (w, -h - 55), f"plate: width_m {board.width_m:.3f}", below=True)
    _dimension(axes, (w + 55, -h), (w + 55, h), f"plate: height_m {board.height_m:.3f}", turned=True)
    text = f"eight squares / 8 = square_m {board.square_m:.3f}"
    _dimension(axes, (x_low - side_mm, h + 40), (x_low + 7 * side_mm, h + 40), text)
    for x in (x_low - side_mm, x_low + 7 * side_mm):
        axes.plot([x, x], [y_high + side_mm, h + 52], color=BLUE, lw=0.8, ls=":")
    axes.annotate(
        f"inner_corners [{board.cols}, {board.rows}]:\nwhere four squares meet",
        xy=(x_low, y_low),
        xytext=(-w - 545, -h * 0.5),
        color=RED,
        arrowprops={"arrowstyle": "->", "color": RED},
        va="center",
    )
    axes.plot(0, 0, "+", color=BLUE, ms=14, mew=2, zorder=4)
    axes.annotate(
        "pattern_offset_m [right, up]:\npattern's centre from\nthe plate's centre",
        xy=(0, 0),
        xytext=(-w - 545, h * 0.5),
        color=BLUE,
        arrowprops={"arrowstyle": "->", "color": BLUE},
        va="center",
        zorder=5,
    )
    axes.set_xlim(-w - 555, w + 130)
    axes.set_ylim(-h - 120, h + 110)


def _dimension(
    axes: Any,
    start: tuple[float, float],
    end: tuple[float, float],
    text: str,
    *,
    below: bool = False,
    turned: bool = False,
) -> None:
    axes.annotate("", xy=end, xytext=start, arrowprops={"arrowstyle": "<->", "color": BLUE, "lw": 1.2})
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    offset = (34, 0) if turned else (0, -34 if below else 32)
    axes.text(
        x + offset[0],
        y + offset[1],
        text,
        color=BLUE,
        ha="center",
        va="center",
        rotation=90 if turned else 0,
    )


def _draw_rings(axes: Any, rig: Rig) -> None:
    board = rig.board.to_board()
    turn = Affine2D().rotate_deg(45)
    outline = turn.transform(1000 * board.outline()[:, :2])
    reach = 1000 * max(board.width_m, board.height_m) * 0.78
    # A VLP-16's rings are 2 deg apart: 70 mm at 2 m.
    for y in range(-7 * 70 + 35, 8 * 70, 70):
        crossings = _crossings(outline, y)
        if len(crossings) == 2:
            axes.plot(crossings, [y, y], color="#c026d3", lw=2)
            axes.plot(crossings, [y, y], "D", color="#f59e0b", ms=6, mec=INK, mew=0.6)
    axes.plot([], [], color="#c026d3", lw=2, label="LiDAR ring on the board (2 m away)")
    axes.plot([], [], "D", color="#f59e0b", mec=INK, label="ring end: a measured point of the edge")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.17), frameon=False)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach * 0.9, reach * 0.9)


def _crossings(outline: Any, y: float) -> list[float]:
    ends = zip(outline, [*outline[1:], outline[0]], strict=True)
    return sorted(
        a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) for a, b in ends if (a[1] - y) * (b[1] - y) < 0
    )
