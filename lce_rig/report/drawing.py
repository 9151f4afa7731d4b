"""Drawings for pages: Matplotlib figures as inline SVG, in the page's font and its light and dark colours."""

import re
from io import StringIO
from typing import Any

from markupsafe import Markup, escape

INK, QUIET, FAINT, SHADE = "#1b1f24", "#5b636b", "#b9c0c8", "#eceff2"
BLUE, ORANGE, GREEN, RED = "#1f6fb4", "#c9660a", "#1a7f4b", "#c62f2f"
# The page's style sheet redefines these in the dark.
_VARIABLES = {
    INK: "ink", QUIET: "quiet", FAINT: "line", SHADE: "shade",
    BLUE: "blue", ORANGE: "orange", GREEN: "good", RED: "bad",
}  # fmt: skip
WIDTH_IN = 4.4
"""Drawings of this width stay legible on a phone; a wide screen shows several side by side."""
_FONT_PT = 8.5
_PAGE_HAS = [
    (re.compile(pattern, re.DOTALL), replacement)
    for pattern, replacement in (
        (r"<metadata>.*?</metadata>|<defs>\s*<style[^>]*>.*?</style>\s*</defs>", ""),
        (r' id="[a-zA-Z0-9.]+_\d+"| target="_blank"| transform="rotate\(-0 [^"]*"', ""),
        (r" font-family: [^;]*;|font: (?=[\d.]+px)", ""),
        (r"\s*\n\s*", "\n"),
    )
]
_STYLE: Any = {
    "text.parse_math": False,
    "svg.fonttype": "none",
    "font.size": _FONT_PT,
    "axes.titlesize": _FONT_PT,
    "axes.labelsize": _FONT_PT,
    "xtick.labelsize": _FONT_PT,
    "ytick.labelsize": _FONT_PT,
    "legend.fontsize": _FONT_PT,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": QUIET,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "text.color": INK,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def style() -> Any:
    """Give the context in which figures of a page are made and drawn."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Any:
    """Start a Matplotlib figure for `drawing`; call it within `style`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in))


def drawing(figure: Any, label: str) -> Markup:
    """Write a figure as inline SVG: the same figure and label give the same bytes.

    An artist's `set_url("#name")` makes it a link.

    Args:
        figure: of Matplotlib, in the colours of this module; call it within `style`.
        label: what it shows, for readers who do not see it; of one page, each has another.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    figure.patch.set_alpha(0.0)
    for axes in figure.axes:
        axes.patch.set_alpha(0.0)
    written = StringIO()
    # Names of clipping paths are hashes of their content; equal ones of two drawings must not be mixed up.
    with rc_context({"svg.hashsalt": label}):
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(written, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return _as_part_of_a_page(written.getvalue(), label)


def _as_part_of_a_page(svg: str, label: str) -> Markup:
    """Leave of an SVG file what a page needs: no names of parts, no fonts and no colours of its own."""
    box = re.search(r'viewBox="[^"]*"', svg)
    assert box is not None
    text = svg[svg.index(">", box.end()) + 1 :]
    for pattern, replacement in _PAGE_HAS:
        text = pattern.sub(replacement, text)
    for colour, name in _VARIABLES.items():
        text = text.replace(colour, f"var(--{name})")
    return Markup(f'<svg {box[0]} role="img" aria-label="{escape(label)}">{text.strip()}')
