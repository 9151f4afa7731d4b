"""Drawings of a page as inline SVG: axes with round ticks, and marks in data coordinates.

Own drawing code: Matplotlib took a third of the time of `calibrate`, mostly for its import.
"""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup, escape

from lce_rig.core.geometry import Array

# Colours of the page's style sheet, which redefines them in the dark.
INK, QUIET, FAINT = "var(--ink)", "var(--quiet)", "var(--line)"
BLUE, ORANGE = "var(--blue)", "var(--orange)"

EM = 8.5
"""Size of the font; all lengths of this module are units of the view box, as long as a point in print."""
WIDTH = 320.0
"""Width of every drawing: legible on a phone, and a wide screen shows several side by side."""
LEFT, RIGHT, TOP, BOTTOM = 4 * EM, EM, 2 * EM, 4 * EM
"""Margins around the axes, for ticks and labels."""
# Distance of texts from the axes.
_GAP = EM / 2
# Fraction of the font size from the middle of a digit to the baseline.
_MIDDLE = 0.36
# Axes of equal scales have one step, of the longer one.
_MOST_STEPS, _MOST_EQUAL_STEPS = 5, 8
# Share of the range that stays free on either side.
_MARGIN = 0.05
# Distant marks are moved here, outside every drawing.
_FAR = 10 * WIDTH
# An arrow's half-widths of shaft and head, and the length of its head.
_SHAFT, _HEAD, _HEAD_LENGTH = 0.6, 1.8, 5.4


def padded(*values: Array, least: float = 0.0) -> tuple[float, float]:
    """Return limits around all finite values with a margin.

    Args:
        values: values of any shapes.
        least: smallest margin, in their unit; equal values get 1 if it is 0.
    """
    every = np.concatenate([np.ravel(each) for each in values])
    every = every[np.isfinite(every)]
    if not len(every):
        return 0.0, 1.0
    low, high = float(every.min()), float(every.max())
    margin = max(_MARGIN * (high - low), least) or 1.0
    return low - margin, high + margin


def round_step(span: float, n_most: int = _MOST_STEPS) -> float:
    """Return 1, 2 or 5 times a power of ten that divides a span into at most `n_most` steps."""
    power = 10.0 ** np.floor(np.log10(span / n_most))
    return float(next(m * power for m in (1, 2, 5, 10) if m * power * n_most >= span * (1 - 1e-9)))


def round_ticks(low: float, high: float, step: float) -> list[tuple[float, str]]:
    """List the multiples of a step from low to high with their labels."""
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    values = [float(k) * step + 0.0 for k in np.arange(first, last + 1)]  # 0 without a sign
    return [(value, f"{value:.{decimals}f}".replace("-", "−")) for value in values]


class Axes:
    """Axes of one drawing, to which marks are added in their order from back to front."""

    def __init__(
        self,
        height: float,
        x_limits: tuple[float, float],
        y_limits: tuple[float, float],
        *,
        x_label: str,
        y_label: str,
        grid: str = "",
        is_equal: bool = False,
        is_framed: bool = False,
    ) -> None:
        """Draw the axes.

        Args:
            height: height of the whole drawing.
            x_limits: data at the left and right end; descending ones mirror the axis.
            y_limits: data at the lower and upper end.
            x_label: quantity and unit.
            y_label: quantity and unit, written above the axis.
            grid: "y" or "xy", the axes whose ticks have grid lines.
            is_equal: use the larger of both scales for both, in the middle of the space.
            is_framed: draw all four borders instead of two.
        """
        self._height = height
        size = np.array([WIDTH - LEFT - RIGHT, height - TOP - BOTTOM])
        spans = np.array([x_limits[1] - x_limits[0], y_limits[1] - y_limits[0]])
        used, steps = size, [round_step(abs(float(span))) for span in spans]
        if is_equal:
            used = np.abs(spans) * (size / np.abs(spans)).min()
            steps = [round_step(float(np.abs(spans).max()), _MOST_EQUAL_STEPS)] * 2
        left, top = np.array([LEFT, TOP]) + (size - used) / 2
        self._box = float(left), float(top), float(left + used[0]), float(top + used[1])
        self._scale = used * [1, -1] / spans
        self._offset = np.array([left, top + used[1]]) - self._scale * [x_limits[0], y_limits[0]]
        self._behind: list[str] = []
        self._marks: list[str] = []
        self._front: list[str] = []
        self._add_ticks(x_limits, y_limits, steps, grid)
        left, top, right, bottom = self._box
        border = f"M{left:.2f} {top:.2f}V{bottom:.2f}H{right:.2f}" + is_framed * f"V{top:.2f}Z"
        self._front.append(f'<path d="{border}" style="{_stroke(FAINT, 0.8)}"/>')
        self._write((left + right) / 2, bottom + 3 * EM, x_label, "middle", QUIET)
        self._write(left, top - _GAP, y_label, "start", INK)

    def _add_ticks(
        self, x_limits: tuple[float, float], y_limits: tuple[float, float], steps: list[float], grid: str
    ) -> None:
        left, top, right, bottom = self._box
        lines = ""
        for value, label in round_ticks(min(x_limits), max(x_limits), steps[0]):
            x = float(self.at([[value, 0]])[0, 0])
            self._write(x, bottom + _GAP + 0.75 * EM, label, "middle", QUIET)
            lines += f"M{x:.2f} {top:.2f}V{bottom:.2f}" * ("x" in grid)
        for value, label in round_ticks(min(y_limits), max(y_limits), steps[1]):
            y = float(self.at([[0, value]])[0, 1])
            self._write(left - _GAP, y + _MIDDLE * EM, label, "end", QUIET)
            lines += f"M{left:.2f} {y:.2f}H{right:.2f}" * ("y" in grid)
        if lines:
            self._behind.append(f'<path d="{lines}" style="{_stroke(FAINT, 0.5)}"/>')

    def _write(self, x: float, y: float, text: str, anchor: str, colour: str) -> None:
        style = f"text-anchor: {anchor}; fill: {colour}"
        self._front.append(f'<text x="{x:.2f}" y="{y:.2f}" style="{style}">{escape(text)}</text>')

    def at(self, points: Array | Sequence[Sequence[float]]) -> Array:
        """Return where data (N, 2) lie in the view box; missing (NaN) ones are outside."""
        at = np.asarray(points) * self._scale + self._offset
        return np.asarray(np.clip(np.nan_to_num(at, nan=-_FAR), -_FAR, _FAR))

    def polygons(
        self, shapes: Sequence[Array], colour: str, *, opacity: float, links: Sequence[str] = ()
    ) -> None:
        """Draw polygons (N, 2), each a link if any are given."""
        drawn = [f'<path d="{_path(self.at(shape))}Z"/>' for shape in shapes]
        style = f"fill: {colour}; fill-opacity: {opacity:.3g}; stroke-opacity: {opacity:.3g}; "
        self._group(_linked(drawn, links), style + f"stroke: {colour}; stroke-width: 0.8")

    def lines(self, starts: Array, ends: Array, colour: str, *, width: float = 0.8) -> None:
        """Draw segments between points (N, 2)."""
        corners = np.hstack([self.at(starts), self.at(ends)])
        path = "M%.2f %.2fL%.2f %.2f" * len(corners) % tuple(corners.ravel())
        self._group([f'<path d="{path}"/>'], _stroke(colour, width))

    def horizontal(self, y: float, colour: str) -> None:
        """Draw a line across the axes."""
        left, _, right, _ = self._box
        at = float(self.at([[0, y]])[0, 1])
        self._group([f'<path d="M{left:.2f} {at:.2f}H{right:.2f}"/>'], _stroke(colour, 0.8))

    def dots(self, points: Array, colour: str, *, size: float, shape: str = "round") -> None:
        """Draw dots of a diameter at points (N, 2), as one element.

        Args:
            points: centres of the dots.
            colour: a colour name of this module.
            size: the diameter, or the side of a square.
            shape: "round" or "square".
        """
        at = self.at(points)
        path = "M%.2f %.2fh0" * len(at) % tuple(at.ravel())
        self._group([f'<path d="{path}"/>'], _stroke(colour, size) + f"; stroke-linecap: {shape}")

    def linked_dots(self, points: Array, colour: str, *, size: float, links: Sequence[str]) -> None:
        """Draw dots of a diameter at points (N, 2), each a link."""
        dots = [f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{size / 2:.2f}"/>' for x, y in self.at(points)]
        self._group(_linked(dots, links), f"fill: {colour}")

    def arrows(self, starts: Array, vectors: Array, colour: str, *, unit: float, key: str) -> None:
        """Draw arrows from points (N, 2) with a key at the upper right.

        Args:
            starts: tails of the arrows.
            vectors: (N, 2) in data units.
            colour: a colour name of this module.
            unit: length in data units of the key's arrow.
            key: label of the key.
        """
        # Vectors turn with the axes.
        self._group([f'<path d="{_arrows(self.at(starts), vectors * self._scale)}"/>'], f"fill: {colour}")
        length, y = unit * abs(float(self._scale[0])), self._box[1] - _GAP - _MIDDLE * EM
        tail = np.array([[self._box[2] - length, y]])
        self._front.append(f'<path d="{_arrows(tail, np.array([[length, 0.0]]))}" style="fill: {colour}"/>')
        self._write(float(tail[0, 0]) - 4, self._box[1] - _GAP, key, "end", INK)

    def _group(self, elements: Sequence[str], style: str) -> None:
        self._marks.append(f'<g style="{style}">{"".join(elements)}</g>')

    def markup(self, label: str, name: str) -> Markup:
        """Return the drawing; the same marks give the same bytes.

        Args:
            label: description of the drawing, for screen readers.
            name: name of its clipping path, unique in the page.
        """
        left, top, right, bottom = self._box
        parts = [
            f'<svg viewBox="0 0 {WIDTH:g} {self._height:.2f}" role="img" aria-label="{escape(label)}"'
            f' style="font-size: {EM}px">',
            f'<clipPath id="{escape(name)}"><rect x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}"'
            f' height="{bottom - top:.2f}"/></clipPath>',
            *self._behind,
            f'<g clip-path="url(#{escape(name)})">',
            *self._marks,
            "</g>",
            *self._front,
            "</svg>",
        ]
        return Markup("\n".join(parts))


def _stroke(colour: str, width: float) -> str:
    return f"fill: none; stroke: {colour}; stroke-width: {width:g}"


def _path(corners: Array) -> str:
    return "M" + ("%.2f %.2fL" * len(corners) % tuple(corners.ravel()))[:-1]


def _linked(elements: Sequence[str], links: Sequence[str]) -> list[str]:
    if not links:
        return list(elements)
    return [f'<a href="{escape(to)}">{each}</a>' for each, to in zip(elements, links, strict=True)]


def _arrows(tails: Array, vectors: Array) -> str:
    """Return the path of arrows (N, 2) in the view box; short ones have smaller heads."""
    length = np.linalg.norm(vectors, axis=1)
    along = vectors / np.maximum(length, 1e-9)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    # The head takes at most the whole arrow.
    size = np.minimum(1.0, length / _HEAD_LENGTH)
    neck = length - 0.9 * _HEAD_LENGTH * size
    base = length - _HEAD_LENGTH * size
    forward = np.stack([0 * length, neck, base, length, base, neck, 0 * length], axis=1)
    aside = size[:, None] * np.array([-_SHAFT, -_SHAFT, -_HEAD, 0, _HEAD, _SHAFT, _SHAFT])
    outline = tails[:, None] + forward[..., None] * along[:, None] + aside[..., None] * across[:, None]
    return ("M" + "L".join(["%.2f %.2f"] * 7) + "Z") * len(outline) % tuple(outline.ravel())
